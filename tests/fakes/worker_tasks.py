"""What processes are given to do in tests; they find it by its name."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path

from nurbseg.app.workers import in_order, open_workers


def is_imported(module: str) -> bool:
    """Return whether the process has imported a module."""
    return module in sys.modules


def process_of(_: object) -> int:
    return os.getpid()


def after_the_second(folder: Path) -> str:
    """Wait for a file that the second task writes."""
    limit_s = time.monotonic() + 60
    while not (folder / "second").exists():
        assert time.monotonic() < limit_s
        time.sleep(0.01)
    return "first"


def named(task: tuple[str, Path]) -> str:
    name, folder = task
    if name == "first":
        return after_the_second(folder)
    (folder / name).touch()
    return name


def fail_at_1(number: int) -> int:
    if number == 1:
        raise FileNotFoundError(2, "gone", "frame.png")
    return number


class UnsendableError(Exception):
    def __init__(self, one: str, two: str) -> None:
        super().__init__(one + two)


def raise_unsendable(_: int) -> None:
    raise UnsendableError("torn ", "apart")


def die_at_2(task: tuple[int, Path, int]) -> int:
    """End this process with the first so many tasks of number 2."""
    number, folder, times = task
    deaths = len(list(folder.iterdir()))
    if number == 2 and deaths < times:
        (folder / str(deaths)).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def sleep(_: int) -> None:
    time.sleep(600)


def sleep_if(number: int) -> int:
    if number:
        sleep(number)
    return number


def start_and_tell(path: str) -> None:
    """For a process of its own: begin a task that never ends, and say which processes there are."""
    with open_workers(2) as workers:
        threading.Thread(target=lambda: list(in_order(workers, sleep, [0])), daemon=True).start()
        found = [future.result() for _, future in in_order(workers, process_of, range(1))]
        Path(path).write_text(str(found[0]))
        time.sleep(600)
