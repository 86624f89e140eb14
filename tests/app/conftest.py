"""The command in this process and as one of its own, small recordings for it, and one result of a frame."""

from __future__ import annotations

import gc
import logging
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import pytest
from fair_clock import FairClock

from nurbseg.app.command.live_command import main

COMMAND = str(Path(sys.executable).with_name("nurbseg-live"))


@pytest.fixture
def live(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., subprocess.CompletedProcess[str]]]:
    """Run nurbseg-live to its end in this process, in an empty folder: it need not be loaded each time."""
    log = logging.getLogger()

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        capfd.readouterr()
        try:
            code = main(words)
        except SystemExit as err:
            code = err.code if isinstance(err.code, int) else 0
        return subprocess.CompletedProcess(words, code, *capfd.readouterr())

    with monkeypatch.context() as patch:
        patch.chdir(tmp_path)
        patch.setattr(log, "handlers", [])
        patch.setenv("OPENBLAS_NUM_THREADS", "1")
        yield run
    logging.captureWarnings(False)
    gc.unfreeze()


@pytest.fixture
def live_process(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run nurbseg-live to its end as a process of its own, in an empty folder."""

    def run(*words: str, **options: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [COMMAND, *words], cwd=tmp_path, capture_output=True, text=True, timeout=120, **options
        )

    return run


class RunningCommand:
    """nurbseg-live while it runs."""

    def __init__(self, words: tuple[str, ...], folder: Path) -> None:
        self.process = subprocess.Popen(
            [COMMAND, *words], cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
        )
        self.said: list[str] = []
        self._lines: queue.Queue[str] = queue.Queue()
        assert self.process.stderr is not None
        self._listener = threading.Thread(target=self._listen, args=(self.process.stderr,))
        self._listener.start()

    def _listen(self, stream: IO[str]) -> None:
        for line in stream:
            self._lines.put(line)

    def wait_for(self, text: str, timeout_s: float = 60.0) -> None:
        """Wait until it says something."""
        deadline_s = time.monotonic() + timeout_s
        while text not in "".join(self.said[-1:]):
            try:
                self.said.append(self._lines.get(timeout=max(0.0, deadline_s - time.monotonic())))
            except queue.Empty:
                pytest.fail(f"never said {text!r}: {self.said}")

    def end_with(self, *numbers: signal.Signals) -> tuple[int, float]:
        """Send signals; return the exit code and how long it took to end by a fair clock, seconds."""
        with FairClock(self.process.pid) as clock:
            for number in numbers:
                self.process.send_signal(number)
            code = self.process.wait(60.0)
        return code, clock.elapsed_s

    def close(self) -> None:
        """End it in any case."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._listener.join()
        assert self.process.stderr is not None
        self.process.stderr.close()
        while not self._lines.empty():
            self.said.append(self._lines.get())


@pytest.fixture
def start_live(tmp_path: Path) -> Iterator[Callable[..., RunningCommand]]:
    """Start nurbseg-live in an empty folder."""
    with ExitStack() as running:
        yield lambda *words: running.enter_context(closing(RunningCommand(words, tmp_path)))


@pytest.fixture
def write_pairs(tmp_path: Path) -> Callable[..., Path]:
    """Write a folder of image pairs of 64 x 48 pixels: a wall with a box before it."""

    def write(frames: int = 3, *, name: str = "pairs", camera: bool = True) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        for index in range(frames):
            depth = np.full((48, 64), 2000, dtype=np.uint16)
            color = np.full((48, 64, 3), 200, dtype=np.uint8)
            depth[12:36, 10 + index : 34 + index] = 1200
            color[12:36, 10 + index : 34 + index] = (30, 60, 160)
            assert cv2.imwrite(os.fspath(folder / f"f{index}_depth.png"), depth)
            assert cv2.imwrite(os.fspath(folder / f"f{index}_color.png"), color)
        if camera:
            (folder / "camera-intrinsics.txt").write_text("60 0 31.5\n0 60 23.5\n0 0 1\n")
        return folder

    return write
