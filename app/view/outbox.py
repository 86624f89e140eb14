"""What waits to be shown or saved: a bounded queue between the worker and the thread of one sink."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")

#: Lines of text that may wait; a sink that is this far behind is told only the latest.
_LINES_MAX = 1000


class Outbox(Generic[T]):
    """A small queue of frames, and of lines of text that go out with them.

    One thread takes; any thread may put. A lossy outbox drops its oldest frame to make room, so that
    putting never waits; a lossless one lets the putting thread wait.

    Parameters
    ----------
    capacity : int
        Frames that may wait.
    lossless : bool
        Whether `put` waits for room rather than dropping a frame.
    """

    def __init__(self, capacity: int, *, lossless: bool) -> None:
        if capacity < 1:
            raise ValueError(f"capacity: expected at least 1 frame, got {capacity}")
        self._capacity = capacity
        self._lossless = lossless
        self._changed = threading.Condition()
        self._frames: deque[T] = deque()
        self._lines: deque[T] = deque(maxlen=_LINES_MAX)
        self._dropped = 0
        self._closed = False

    @property
    def dropped(self) -> int:
        """Frames dropped to make room."""
        with self._changed:
            return self._dropped

    def put(self, frame: T, timeout_s: float) -> None:
        """Add a frame.

        Parameters
        ----------
        frame : object
            What the sink takes.
        timeout_s : float
            Longest wait for room, seconds; a lossy outbox does not wait.

        Raises
        ------
        TimeoutError
            If a lossless outbox had no room in time; the frame is not added.
        """
        with self._changed:
            if self._lossless:
                room = self._changed.wait_for(
                    lambda: self._closed or len(self._frames) < self._capacity, timeout_s
                )
                if not room:
                    raise TimeoutError(f"no room for a frame within {timeout_s:g} s")
            if self._closed:
                return
            if len(self._frames) >= self._capacity:
                self._frames.popleft()
                self._dropped += 1
            self._frames.append(frame)
            self._changed.notify_all()

    def put_line(self, line: T) -> None:
        """Add a line of text; never waits, and drops the oldest of very many."""
        with self._changed:
            if not self._closed:
                self._lines.append(line)
                self._changed.notify_all()

    def take(self, timeout_s: float) -> list[T]:
        """Return what is due: all lines and at most one frame, which comes last.

        Empty if nothing came within `timeout_s` seconds.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._frames or self._lines or self._closed, timeout_s)
            due = list(self._lines)
            self._lines.clear()
            if self._frames:
                due.append(self._frames.popleft())
            self._changed.notify_all()
            return due

    def close(self) -> None:
        """Accept nothing more; what waits can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """Whether nothing more is accepted."""
        with self._changed:
            return self._closed

    @property
    def finished(self) -> bool:
        """Whether it is closed and everything was taken."""
        with self._changed:
            return self._closed and not self._frames and not self._lines


__all__ = ["Outbox"]
