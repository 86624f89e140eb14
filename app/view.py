"""The view: what shows each frame's result and saves it for viewing."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from types import TracebackType
from typing import Protocol, Self

from nurbseg.app.view_config import ViewConfig
from nurbseg.app.viewer_process import ViewError
from nurbseg.app.worker import FrameResult
from nurbseg.segmentation.config import SegmentationConfig


class View(Protocol):
    """What shows results; a context manager that closes itself."""

    @property
    def how_to_look(self) -> str:
        """What a person does to see it; empty where a window opens by itself or nothing is shown."""
        ...

    @property
    def serving(self) -> bool:
        """Whether a web page is served, which ends with this view."""
        ...

    def show(self, result: FrameResult) -> None:
        """Take a frame's result; never waits for a viewer."""
        ...

    def close(self) -> None:
        """End within 2 s, with files whole; safe to call twice."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...


class NullView:
    """Shows nothing."""

    #: How to look at what is shown; empty.
    how_to_look = ""
    #: Whether others may look as long as this process runs; never.
    serving = False

    def show(self, result: FrameResult) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


def open_view(
    config: ViewConfig,
    segmentation: SegmentationConfig,
    metadata: Mapping[str, str] | None = None,
    *,
    name: str = "nurbseg",
    logger: logging.Logger | None = None,
) -> View:
    """Open the view that a configuration asks for.

    Parameters
    ----------
    config : ViewConfig
        Where to show and to save.
    segmentation : SegmentationConfig
        Of the run; kept with the recording.
    metadata : mapping of str to str, optional
        What is known of the device.
    name : str
        What the recording is called.
    logger : logging.Logger, optional
        Whose messages are shown too; the package's by default.

    Returns
    -------
    View
        Its `how_to_look` tells a person how to see it, where that needs telling.

    Raises
    ------
    ViewError
        If the file cannot be created, a port is taken, or the viewer cannot be started.
    """
    if config.mode == "none" and config.save is None:
        return NullView()
    # Late: Rerun takes a while to import, and a run without a view needs none of it.
    from nurbseg.app.view_rerun import RerunView

    return RerunView(config, segmentation, metadata or {}, name, logger or logging.getLogger("nurbseg"))


__all__ = ["NullView", "View", "ViewError", "open_view"]
