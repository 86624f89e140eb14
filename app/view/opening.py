"""Opens the view that a configuration asks for, and starts its process early."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.view import View
from nurbseg.app.view.viewer import check_rerun, chosen_mode, is_taken
from nurbseg.segmentation.config import SegmentationConfig

if TYPE_CHECKING:
    from nurbseg.common.process.child import ChildProcess

_NO_DISPLAY = (
    "no display (neither DISPLAY nor WAYLAND_DISPLAY is set), so nothing is shown: "
    "serve a web page (--view serve), connect to a viewer elsewhere (--connect HOST), "
    "or save a recording (--save FILE.rrd) and open it with 'rerun FILE.rrd'"
)


def chosen_view(config: ViewConfig, *, interactive: bool) -> ViewConfig:
    """Replace "auto" by a served page if no window can be opened and `interactive` at a terminal.

    If the usual ports are in use, any free ones are taken.
    """
    if config.mode != "auto" or chosen_mode(config, interactive=interactive) != "serve":
        return config
    port, web_port = (0 if is_taken(config.bind, each) else each for each in (config.port, config.web_port))
    return replace(config, mode="serve", port=port, web_port=web_port)


def begin_view(config: ViewConfig) -> ChildProcess | None:
    """Start the process that shows and saves; None if there is nothing to show or save.

    It imports its libraries while the run opens its source. Logging a frame to Rerun is mostly Python code,
    which in the segmenting process would hold the interpreter's lock. Raises ViewError if Rerun is too old,
    or the process cannot be started.
    """
    if chosen_mode(config) == "none" and config.save is None:
        return None
    check_rerun()
    from nurbseg.common.process.child import ChildProcess

    try:
        return ChildProcess("nurbseg.app.view.program", quiet=False)
    except OSError as err:
        raise ViewError(f"the view process cannot be started: {err}") from err


def open_view(
    config: ViewConfig,
    segmentation: SegmentationConfig,
    metadata: Mapping[str, str] | None = None,
    *,
    name: str = "nurbseg",
    process: ChildProcess | None = None,
    is_outlived: Callable[[], bool] = lambda: False,
    ask: Callable[[str, int], object] = lambda *_: None,
) -> View:
    """Open the view that a configuration asks for, in `process` if `begin_view` already started it.

    `metadata` describes the device; `is_outlived` says whether the run also records or exports; `ask` is
    given the commands of the page, in a thread of its own. The package's log is shown, too. Raises ViewError
    if the file cannot be created, a port is in use, or the viewer cannot be started.
    """
    process = process or begin_view(config)
    if process is None:
        return View("" if config.mode == "none" else _NO_DISPLAY)
    # Late: most drawing code is compiled, and a run without a view needs none of it.
    from nurbseg.app.view.isolated import IsolatedView

    return IsolatedView(process, config, segmentation, metadata or {}, name, is_outlived, ask)
