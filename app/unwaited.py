"""Standard error of a run, which waits neither for a terminal that is frozen nor for a reader of its log."""

import os
import signal
import sys
import threading
from contextlib import suppress
from io import UnsupportedOperation
from typing import Any, Self, TextIO, cast

from nurbseg.common.process.bounded_queue import BoundedQueue

#: Characters that may wait to be written; of more, the oldest messages are dropped.
_WAITING_MAX = 1_000_000
#: Longest wait at the end, seconds.
_END_S = 1.0


class Unwaited:
    """A text stream whose content a thread writes to another stream, which replaces `sys.stderr` in a block.

    Nor is a process stopped for writing to its terminal from the background (SIGTTOU).
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._queue: BoundedQueue[str] = BoundedQueue(_WAITING_MAX, "drop oldest", len)
        # A daemon: nothing ends a write to a full pipe.
        self._thread = threading.Thread(target=self._copy, name="messages", daemon=True)

    def __enter__(self) -> Self:
        self._before = signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        self._thread.start()
        sys.stderr = cast(TextIO, self)
        return self

    def __exit__(self, *_: object) -> None:
        sys.stderr = self._stream
        self._queue.close()
        self._thread.join(_END_S)
        signal.signal(signal.SIGTTOU, self._before)

    def write(self, text: str) -> int:
        """Write a text soon."""
        self._queue.put(text)
        return len(text)

    def flush(self) -> None:
        """Do nothing: the thread flushes."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _copy(self) -> None:
        for text in self._queue:
            # The terminal may be gone, or the disk full.
            with suppress(OSError, ValueError):
                self._put(text)

    def _put(self, text: str) -> None:
        try:
            descriptor = self._stream.fileno()
        except UnsupportedOperation:  # as of a stream in memory
            self._stream.write(text)
            return
        # Past the stream, whose lock Python would wait for at its end.
        content = text.encode(errors="backslashreplace")
        while content:
            content = content[os.write(descriptor, content) :]
