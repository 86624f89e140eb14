"""The view, which shows each frame's result and saves it for viewing, and what is sent to its process."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.common.closing import Closing
from nurbseg.segmentation.config import SegmentationConfig

if TYPE_CHECKING:
    from nurbseg.app.control.commands import RunState
    from nurbseg.app.view.drawing.frame import Moment
    from nurbseg.library.result import FrameResult

_log = logging.getLogger(__name__)

#: Longest time without a result shown, seconds.
_LONGEST_GAP_S = 1.0


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


@dataclass(frozen=True, slots=True)
class Open:
    """Open the viewer and the file; `properties` are stored with the recording, by subject."""

    config: ViewConfig
    segmentation: SegmentationConfig
    properties: Mapping[str, Mapping[str, str]]
    name: str
    log_level: int


@dataclass(frozen=True, slots=True)
class Line:
    """A log line to show, and its level."""

    moment: Moment
    level: int
    text: str


@dataclass(frozen=True, slots=True)
class Asked:
    """A command that somebody gave on the page; `number` counts them from 1."""

    command: str
    number: int


@dataclass(frozen=True, slots=True)
class Close:
    """End; the file must be complete within so many seconds."""

    file_limit_s: float


@dataclass(frozen=True, slots=True)
class State:
    """State of the process, which sends it after opening and whenever it has changed."""

    viewer_hint: str = ""
    serving: bool = False
    #: Frames that were not shown live, and connections to a viewer so far.
    dropped: int = 0
    connections: int = 0
    #: The first thing that could not be opened, shown or saved; empty if there is none.
    problem: str = ""
    #: Whether everything was shown and saved.
    closed: bool = False
