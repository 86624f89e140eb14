"""Writes the explanation of a frame, and shows it in a viewer."""

import logging
import subprocess
from datetime import datetime
from pathlib import Path

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.explanation import save_explanation
from nurbseg.app.view.viewer import chosen_mode, listens, reachable, start_viewer, viewer_command
from nurbseg.library.result import FrameResult

_log = logging.getLogger(__name__)

#: Longest time that a viewer may take for an explanation, seconds.
_TAKEN_S = 10.0


def write_explanation(result: FrameResult, folder: Path) -> Path:
    """Write a page, pictures and a recording for Rerun; return the recording.

    Raises
    ------
    OSError
        If the folder or a file cannot be written.
    """
    explanation = result.explain()
    page, recording = explanation.save(folder), folder / "explanation.rrd"
    save_explanation(explanation, recording)
    _log.info("explanation in %d steps: %s", len(explanation.steps), page)
    return recording


def dated_folder(result: FrameResult) -> Path:
    """Return the name of a new folder for the explanation of a frame."""
    return Path.cwd() / f"explanation-{datetime.now():%Y%m%d-%H%M%S}-frame{result.frame.index}"


def show_explanation(recording: Path, view: ViewConfig) -> None:
    """Open a recording in the viewer or on the page that listens on the view's port; say how if none does."""
    if chosen_mode(view) not in ("spawn", "serve") or not listens(reachable(view.bind), view.port):
        _log.info("to look: %s", viewer_command(recording))
        return
    # A second viewer for the same port passes its file on to the first, and ends.
    try:
        start_viewer(view, view.port, str(recording), detached=False).wait(_TAKEN_S)
    except (ViewError, subprocess.TimeoutExpired) as err:
        look = viewer_command(recording)
        _log.warning("the viewer does not take the explanation (%s); to look: %s", err, look)


def explain_in_run(result: FrameResult, view: ViewConfig) -> None:
    """Write the explanation of a frame of a run to a new folder and show it; an error is logged."""
    try:
        show_explanation(write_explanation(result, dated_folder(result)), view)
    except OSError as err:
        _log.error("the explanation cannot be written: %s", err)
