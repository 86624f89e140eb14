"""Ctrl-C, SIGTERM and a closed terminal (SIGHUP), which end a run cleanly."""

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

#: Functions that LLVM calls to load compiled code; an exception is lost there, and LLVM crashes without them.
_CALLED_BACK, _AGAIN_S = ("_raw_object_cache_getbuffer", "_raw_object_cache_notify"), 0.05


class Interruption:
    """Turns the first SIGINT, SIGTERM or SIGHUP into a `KeyboardInterrupt` on the main thread.

    Call `check` where the run can end, because the exception can get lost in a callback of a library. After
    `hold`, signals raise nothing, so that files are closed undisturbed.
    """

    def __init__(self) -> None:
        #: The first signal.
        self.signal_number: int | None = None
        self._held = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # A run started with nohup outlives its terminal.
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @property
    def exit_code(self) -> int:
        """The exit code of a process that a signal ended: 130 for Ctrl-C."""
        return 128 + (self.signal_number or signal.SIGINT)

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if a signal came."""
        if self.signal_number is not None:
            raise KeyboardInterrupt

    def hold(self) -> None:
        """Let signals no longer raise an exception."""
        self._held = True

    def wait(self, until: Callable[[], bool] = lambda: False) -> None:
        """Wait until a condition holds; a signal raises `KeyboardInterrupt`."""
        self._held = False
        while not until():
            self.check()
            time.sleep(0.2)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        while frame is not None:
            if frame.f_code.co_name in _CALLED_BACK:
                threading.Timer(_AGAIN_S, signal.raise_signal, [number]).start()
                return
            frame = frame.f_back
        if self.signal_number is None:
            self.signal_number = number
            if not self._held:
                raise KeyboardInterrupt
