"""Writes what commands ask of one frame: a snapshot with all its files, and its explanation."""

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import cv2

from nurbseg.app.errors import ExportError
from nurbseg.app.export.exporter import Exporter
from nurbseg.app.export.frame_files import png
from nurbseg.app.export.run_settings import RunSettings
from nurbseg.app.live.control.controls import Controls
from nurbseg.app.settings.output_config import ExportConfig, ViewConfig
from nurbseg.library.result import FrameResult


def write_wanted(result: FrameResult, settings: RunSettings, controls: Controls, view: ViewConfig) -> None:
    """Write the snapshot and the explanation of a frame that commands asked for."""
    if controls.snapshot:
        controls.snapshot = False
        write_snapshot(result, settings, Path.cwd(), controls.say)
    if controls.explanation:
        controls.explanation = False
        from nurbseg.app.live.explaining import write_explanation

        try:
            controls.explained = str(write_explanation(result, view))
        except OSError as err:
            controls.say(f"{err.filename}: the explanation cannot be written: {err.strerror}", refused=True)
        else:
            controls.say(f"explanation: {controls.explained}")


def write_snapshot(
    result: FrameResult, settings: RunSettings, folder: Path, say: Callable[..., None]
) -> None:
    """Write all files of a frame to a new folder, and `Controls.say` where, or why that failed.

    These are color, depth, labels, objects, tree, surfaces and cloud.
    """
    frame = result.frame
    made = folder / f"snapshot-{datetime.now():%Y%m%d-%H%M%S}-frame{frame.index}"
    try:
        # Images are private.
        made.mkdir(mode=0o700)
        forms = ExportConfig(objects=True, preview=True, cloud="ply", graph=True)
        exporter = Exporter(made, replace(settings, surfaces=True), forms)
        exporter.write(result)
        images = {"color": cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR), "depth": frame.depth_mm}
        exporter.write_files({f"{frame.index:06d}_{name}.png": png(image) for name, image in images.items()})
    except OSError as err:
        say(f"{made}: cannot be created: {err.strerror}", refused=True)
    except ExportError as err:
        say(str(err), refused=True)
    else:
        say(f"snapshot: {made}")
