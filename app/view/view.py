"""The view, which shows each frame's result and saves it for viewing."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from nurbseg.common.closing import Closing

if TYPE_CHECKING:
    from nurbseg.app.control.commands import RunState
    from nurbseg.library.result import FrameResult

_log = logging.getLogger(__name__)


class View(Closing):
    """A context manager that shows each frame's result; this one shows nothing."""

    #: Whether it does anything with a result.
    shows = False
    #: Whether boxes, surfaces and the table of objects are drawn for each frame, or as often as is seen.
    every_frame_in_full = True
    #: Whether it serves a web page until it is closed.
    serving = False
    #: Why nothing more is shown or saved, although the run goes on; empty while all is well.
    failure = ""

    def __init__(self, viewer_hint: str = "", is_outlived: Callable[[], bool] = lambda: False) -> None:
        #: What the user must do to see it; empty if a window opens or there is nothing to see.
        self.viewer_hint = viewer_hint
        #: Whether the run also records or exports, and so outlives this.
        self.is_outlived = is_outlived

    @property
    def dropped(self) -> int:
        """Frames that were not shown live because the viewer was slow, frozen or absent."""
        return 0

    def peak_memory_mb(self) -> float:
        """Return the peak resident memory of the process that shows and saves, 10^6 bytes."""
        return 0.0

    def tell(self, state: RunState) -> None:
        """Tell its users the state of the run; never waits."""

    def show(self, result: FrameResult) -> None:
        """Show a frame's result; never waits for a viewer."""

    def close(self) -> None:
        """Close within 2 s, with files complete; may be called twice."""


#: Longest time without a result shown, seconds.
_LONGEST_GAP_S = 1.0


class LatencyFilter:
    """Holds back results that are older than `age_max_ms`, or none if it is 0, and counts them."""

    def __init__(self, age_max_ms: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.held_back = 0
        self._age_max_ms = age_max_ms
        self._clock = clock
        self._shown_s: float | None = None
        self._said = False

    def passes(self, age_ms: float) -> bool:
        """Return whether to show a result of this age: the first always, later ones at least every second."""
        now_s = self._clock()
        if self._age_max_ms > 0 and age_ms > self._age_max_ms and self._shown_s is not None:
            if now_s - self._shown_s < _LONGEST_GAP_S:
                self.held_back += 1
                return False
            if not self._said:
                self._said = True
                _log.warning(
                    "labels come %.0f ms after their frame; of those over %g ms only one per second is shown",
                    age_ms,
                    self._age_max_ms,
                )
        self._shown_s = now_s
        return True
