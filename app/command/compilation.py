"""Says that loops are being compiled, which the first run on a computer waits for."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from numba.core import event

_log = logging.getLogger(__name__)


@contextmanager
def logged_compilation() -> Iterator[None]:
    """Say once, while the block runs, that code is compiled; and at the end of the block how long it took."""
    listener = _Listener()
    try:
        with event.install_listener("numba:compile", listener):
            yield
    finally:
        if listener.spent_s > 0:
            _log.info("compiling took %.0f s; later runs find the code on disk", listener.spent_s)


class _Listener(event.Listener):
    """Adds up the time that is spent compiling; functions within functions count once."""

    def __init__(self) -> None:
        self.spent_s = 0.0
        self._lock = threading.Lock()
        self._depth = 0
        self._began_s = 0.0
        self._said = False

    def on_start(self, event: event.Event) -> None:
        with self._lock:
            if not self._said:
                _log.info("compiling the inner loops; this takes half a minute, once on a computer")
                self._said = True
            if self._depth == 0:
                self._began_s = time.monotonic()
            self._depth += 1

    def on_end(self, event: event.Event) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                self.spent_s += time.monotonic() - self._began_s
