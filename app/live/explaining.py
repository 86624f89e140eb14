"""Explains one frame: of a run, or instead of one (``nurbseg-live --explain``)."""

import logging
import shutil
import subprocess
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from nurbseg.app.live.opening import open_chosen
from nurbseg.app.settings.app_config import AppConfig
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.viewer import chosen_mode
from nurbseg.common.process.child import ChildProcess, environment
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.points.depth_preparation import DepthPreparation

_log = logging.getLogger(__name__)


def write_explanation(result: FrameResult, view: ViewConfig, path: Path | None = None) -> Path:
    """Write the explanation of a frame as a page, and open it where the viewer is a window.

    Raises OSError if the page cannot be written.
    """
    path = path or Path.cwd() / f"explanation-{datetime.now():%Y%m%d-%H%M%S}-frame{result.frame.index}.html"
    explanation = result.explain()
    explanation.save(path)
    _log.info("explanation in %d steps, for any browser: %s", len(explanation.steps), path)
    if chosen_mode(view) == "spawn" and (opener := shutil.which("xdg-open")) is not None:
        # In the background of a shell that ends at once: a browser may stay as long as it likes.
        words = ["sh", "-c", '"$0" "$1" >/dev/null 2>&1 </dev/null &', opener, str(path)]
        subprocess.run(words, env=environment(), check=False)
    return path


def explain(config: AppConfig, source_process: ChildProcess | None = None) -> None:
    """Segment the frame that the configuration names by itself, and write why it was segmented so.

    Raises DriverError or OSError if a file cannot be read or written, ValueError if two sources are named.
    """
    source, what = replace(config.source, speed=0.0), config.explain.what or ""
    if not what.isdecimal() and source.named:
        raise ValueError(f"--explain {what}: expected the number of a frame, since a source is named too")
    source = replace(source, start=int(what)) if what.isdecimal() else replace(source, replay=what)
    opened = open_chosen(replace(config, source=source), source_process)
    with opened.source:
        prepare = DepthPreparation(config.depth, config.segmentation.extended.inverse_depth_noise)
        result = process_frame(prepare.prepared(opened.source.read(10.0)), config.segmentation)
    file = config.explain.file
    write_explanation(result, config.view, None if file is None else Path(file))
