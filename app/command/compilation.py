"""Logs the progress of compiling, which the first run on a computer waits for."""

import gc
import logging
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from nurbseg.common.code_cache import CACHE_ADVICE, cache_error
from nurbseg.common.compiled import event

_log = logging.getLogger(__name__)

#: Time between two log lines, seconds.
_PROGRESS_S = 5.0
#: Longest wait for its end after it was killed, seconds.
_KILLED_S = 5.0


@contextmanager
def logged_compilation() -> Iterator[None]:
    """Log the progress of compiling while the block runs, and its duration at the end."""
    listener = _Listener()
    try:
        with event.install_listener("numba:compile", listener):
            yield
    finally:
        listener.end()
        if listener.spent_s > 0:
            later = "; later runs load the code from disk" if not cache_error() else ""
            _log.info("compiling took %.0f s%s", listener.spent_s, later)


class _Listener(event.Listener):
    """Measures the time spent compiling; nested functions count once."""

    def __init__(self) -> None:
        self.spent_s = 0.0
        self._lock = threading.Lock()
        self._depth = 0
        self._began_s = self._told_s = 0.0
        self._done = 0
        self._thresholds = gc.get_threshold()
        self._beside: subprocess.Popen[bytes] | None = None
        self._ended = False

    def _start_beside(self) -> None:
        """Start to compile on another core what is called later."""
        from nurbseg.common.process.child import environment, python_command, with_parent_death_signal

        nowhere = subprocess.DEVNULL
        # Without it, everything is compiled in this process.
        with suppress(OSError):
            if (os.cpu_count() or 1) > 1 and not self._ended:
                self._beside = subprocess.Popen(
                    with_parent_death_signal(python_command("nurbseg.app.command.ahead")),
                    env=environment(),
                    stdin=nowhere,
                    stdout=nowhere,
                    stderr=nowhere,
                )

    def end(self) -> None:
        """End the other process if it is still compiling, and start none from now on."""
        with self._lock:
            self._ended = True
        if self._beside is not None:
            self._beside.kill()
            with suppress(subprocess.TimeoutExpired):
                self._beside.wait(_KILLED_S)

    def on_start(self, event: event.Event) -> None:
        with self._lock:
            if not self._told_s:
                often = "once per computer"
                if problem := cache_error():
                    often = f"in every run: to keep the code, {CACHE_ADVICE} ({problem})"
                _log.info("compiling the inner loops; this takes about 12 s, %s", often)
                self._told_s = time.monotonic()
                self._start_beside()
            if self._depth == 0:
                from nurbseg.app.command.ahead import GARBAGE_THRESHOLD

                self._began_s = time.monotonic()
                self._thresholds = gc.get_threshold()
                gc.set_threshold(GARBAGE_THRESHOLD, *self._thresholds[1:])
            self._depth += 1

    def on_end(self, event: event.Event) -> None:
        with self._lock:
            self._depth -= 1
            self._done += 1
            now_s = time.monotonic()
            if now_s - self._told_s >= _PROGRESS_S:
                _log.info("compiling: %d functions done", self._done)
                self._told_s = now_s
            if self._depth == 0:
                self.spent_s += now_s - self._began_s
                gc.set_threshold(*self._thresholds)
