"""The view, which shows each frame's result and saves it for viewing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from nurbseg.common.closing import Closing

if TYPE_CHECKING:
    from nurbseg.app.control.run_state import RunState
    from nurbseg.library.result import FrameResult


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

    def commands(self) -> Iterator[str]:
        """Yield what its users asked of the run since the last call."""
        return iter(())

    def tell(self, state: RunState) -> None:
        """Tell its users the state of the run; never waits."""

    def show(self, result: FrameResult) -> None:
        """Show a frame's result; never waits for a viewer."""

    def close(self) -> None:
        """Close within 2 s, with files complete; may be called twice."""
