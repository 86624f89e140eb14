"""The view: what shows each frame's result and saves it for viewing."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from types import TracebackType
from typing import Protocol, Self

from nurbseg.app.result import FrameResult
from nurbseg.app.view.config import ViewConfig
from nurbseg.app.view.process import begin_view
from nurbseg.app.view.viewer import ViewError
from nurbseg.drivers.process.child import ChildProcess
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

    def peak_memory_mb(self) -> float:
        """Return the largest resident size of what shows and saves for this program, 10^6 bytes."""
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
    """Shows nothing.

    Attributes
    ----------
    how_to_look : str
        What a person may do to see something all the same; may be empty.
    """

    #: Whether others may look as long as this process runs; never.
    serving = False

    def __init__(self, how_to_look: str = "") -> None:
        self.how_to_look = how_to_look

    def peak_memory_mb(self) -> float:
        """Return 0."""
        return 0.0

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
    process: ChildProcess | None = None,
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
    process : ChildProcess, optional
        Which was started for this configuration before.

    Returns
    -------
    View
        Its `how_to_look` tells a person how to see it, where that needs telling.

    Raises
    ------
    ViewError
        If the file cannot be created, a port is taken, or the viewer cannot be started.
    """
    process = process or begin_view(config)
    if process is None:
        return NullView("" if config.mode == "none" else _NO_DISPLAY)
    # Late: most of what draws is compiled, and a run without a view needs none of it.
    from nurbseg.app.view.isolated import IsolatedView

    return IsolatedView(
        process, config, segmentation, metadata or {}, name, logger or logging.getLogger("nurbseg")
    )


_NO_DISPLAY = (
    "no display (neither DISPLAY nor WAYLAND_DISPLAY is set), so nothing is shown: "
    "serve a web page (--view serve), connect to a viewer elsewhere (--connect HOST), "
    "or save a recording (--save FILE.rrd) and open it with 'rerun FILE.rrd'"
)

__all__ = ["NullView", "View", "ViewError", "open_view"]
