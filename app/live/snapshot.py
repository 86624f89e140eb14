"""Writes one frame: as a snapshot with all its files, or as the explanation of its segmentation."""

import logging
import shutil
import subprocess
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import cv2

from nurbseg.app.errors import ExportError
from nurbseg.app.export.exporter import Exporter
from nurbseg.app.export.frame_files import png
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.app.live.controls import Controls
from nurbseg.app.live.opening import open_chosen
from nurbseg.app.settings.app_config import AppConfig
from nurbseg.app.settings.output_config import ExportConfig, ViewConfig
from nurbseg.app.view.viewer import chosen_mode
from nurbseg.common.process.child import ChildProcess, environment
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.points.depth_preparation import DepthPreparation

_log = logging.getLogger(__name__)


def write_wanted(result: FrameResult, settings: RunSettings, controls: Controls, view: ViewConfig) -> None:
    """Write what commands asked for of a frame, and say where, or why that failed."""
    wanted, controls.wanted = controls.wanted, set()
    try:
        if "snapshot" in wanted:
            controls.say(f"snapshot: {write_snapshot(result, settings, Path.cwd())}")
        if "explain" in wanted:
            controls.explained = str(write_explanation(result, view))
            controls.say(f"explanation: {controls.explained}")
    except OSError as err:
        controls.say(f"{err.filename}: cannot be written: {err.strerror}", refused=True)
    except ExportError as err:
        controls.say(str(err), refused=True)


def write_snapshot(result: FrameResult, settings: RunSettings, folder: Path) -> Path:
    """Write color, depth, labels, objects, tree, surfaces and cloud of a frame to a new folder; return it.

    Raises OSError if the folder cannot be created, and ExportError if a file cannot be written.
    """
    frame = result.frame
    made = folder / f"snapshot-{datetime.now():%Y%m%d-%H%M%S}-frame{frame.index}"
    # Images are private.
    made.mkdir(mode=0o700)
    forms = ExportConfig(objects=True, preview=True, cloud="ply", graph=True)
    exporter = Exporter(made, replace(settings, surfaces=True), forms)
    exporter.write(result)
    images = {"color": cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR), "depth": frame.depth_mm}
    exporter.write_files({f"{frame.index:06d}_{name}.png": png(image) for name, image in images.items()})
    return made


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
