"""Time as a program is accountable for it: without what other programs took from it."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Self

import psutil

#: Threads end, and their figures with them, so they are looked at this often, seconds.
_INTERVAL_S = 0.02


class FairClock:
    """Measures how long a block takes, less the time in which threads were ready and got no processor.

    A limit like "ends within 2 s" can then be held to on a busy computer as well: whoever waits for
    something that does not come, or sleeps, or computes for too long, is charged all of it. Where the
    kernel does not tell the delays, none is taken off.

    Parameters
    ----------
    process : int, optional
        The process that is held to account, with its children as of now; this one by default.

    Attributes
    ----------
    elapsed_s : float
        How long the block took, once it has ended.
    """

    def __init__(self, process: int | None = None) -> None:
        watched = psutil.Process(process)
        self._folders = [
            Path(f"/proc/{child.pid}/task") for child in (watched, *watched.children(recursive=True))
        ]
        self._delays_ns: dict[Path, tuple[int, int]] = {}
        self._ended = threading.Event()
        self._watching = threading.Thread(target=self._watch, name="fair-clock")
        self.elapsed_s = 0.0

    def __enter__(self) -> Self:
        self._look()
        self._watching.start()
        self._began = self._lap = (time.monotonic(), self._delay_s())
        return self

    def __exit__(self, *_: object) -> None:
        ended_s = time.monotonic()
        self._ended.set()
        self._watching.join()
        self._look()
        began_s, delay_s = self._began
        self.elapsed_s = ended_s - began_s - (self._delay_s() - delay_s)

    def lap_s(self) -> float:
        """Return the time since the last call, or since the block began, seconds."""
        before_s, delay_before_s = self._lap
        now_s = time.monotonic()
        self._look()
        self._lap = (time.monotonic(), self._delay_s())
        return now_s - before_s - (self._lap[1] - delay_before_s)

    def _delay_s(self) -> float:
        return 1e-9 * sum(last - first for first, last in list(self._delays_ns.values()))

    def _watch(self) -> None:
        while not self._ended.wait(_INTERVAL_S):
            self._look()

    def _look(self) -> None:
        for folder in self._folders:
            try:
                threads = list(folder.iterdir())
            except OSError:
                continue  # it has ended
            for thread in threads:
                if thread.name == str(self._watching.native_id):
                    continue
                try:
                    delay_ns = int((thread / "schedstat").read_text().split()[1])
                except (OSError, IndexError, ValueError):
                    continue
                first, _ = self._delays_ns.get(thread, (delay_ns, delay_ns))
                self._delays_ns[thread] = (first, delay_ns)


__all__ = ["FairClock"]
