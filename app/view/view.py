"""The view: what shows each frame's result and saves it for viewing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from nurbseg.app.result import FrameResult
    from nurbseg.segmentation.config import Metric


class View:
    """What shows each frame's result, a context manager that closes itself; this one shows nothing.

    Attributes
    ----------
    shows : bool
        Whether it does anything with a result.
    how_to_look : str
        What a person does to see it; empty where a window opens by itself or there is nothing to see.
    serving : bool
        Whether a web page is served, which ends with this view.
    metric : str
        Which of the metrics is shown of each segment.
    """

    shows = False
    metric: Metric = "mse"

    def __init__(self, how_to_look: str = "") -> None:
        self.how_to_look, self.serving = how_to_look, False

    @property
    def dropped(self) -> int:
        """Frames that were not shown live because the viewer was slow, frozen or absent."""
        return 0

    def peak_memory_mb(self) -> float:
        """Return the largest resident size of what shows and saves for this program, 10^6 bytes."""
        return 0.0

    def show(self, result: FrameResult) -> None:
        """Take a frame's result; never waits for a viewer."""

    def close(self) -> None:
        """End within 2 s, with files whole; safe to call twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
