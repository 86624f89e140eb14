"""SIGINT (Ctrl-C) and SIGTERM: both end a run cleanly, once, and not in the middle of closing files."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, Self


class Interruption:
    """Turns SIGINT and SIGTERM into one `KeyboardInterrupt` on the main thread.

    The signal is remembered as well, because an exception can get lost in a callback of foreign code:
    call `check` where the run can end. After `hold`, signals are remembered only, so that nothing
    disturbs the closing of files.

    Attributes
    ----------
    signal_number : int or None
        The first signal that came.
    """

    def __init__(self) -> None:
        self.signal_number: int | None = None
        self._held = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    @property
    def exit_code(self) -> int:
        """What a shell expects of a process that such a signal ended: 130 for Ctrl-C."""
        return 128 + (self.signal_number or signal.SIGINT)

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if a signal came and its exception got lost."""
        if self.signal_number is not None:
            raise KeyboardInterrupt

    def hold(self) -> None:
        """Let no signal raise any more."""
        self._held = True

    def wait(self, until: Callable[[], bool] = lambda: False) -> None:
        """Wait until something is so, or for a signal: then it ends with `KeyboardInterrupt`."""
        self._held = False
        while not until():
            self.check()
            time.sleep(0.2)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        first = self.signal_number is None
        if first:
            self.signal_number = number
        if first and not self._held:
            raise KeyboardInterrupt
