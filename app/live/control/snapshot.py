"""Writes a snapshot: all files of one frame, in a new folder."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2

from nurbseg.app.export.config import ExportConfig
from nurbseg.app.export.exporter import Exporter, ExportError
from nurbseg.app.result import FrameResult

_log = logging.getLogger(__name__)


def try_snapshot(result: FrameResult, settings: Mapping[str, Any], folder: Path) -> None:
    """Write a snapshot and log where, or why that failed."""
    try:
        _log.info("snapshot: %s", write_snapshot(result, settings, folder))
    except ExportError as err:
        _log.error("%s", err)


def write_snapshot(result: FrameResult, settings: Mapping[str, Any], folder: Path) -> Path:
    """Write color, depth, labels, objects, tree, surfaces and cloud of a frame; return the new folder.

    `settings` comes from `run_settings`. Raises ExportError if a file cannot be written.
    """
    frame = result.frame
    made = folder / f"snapshot-{datetime.now():%Y%m%d-%H%M%S}-frame{frame.index}"
    try:
        # Images are private.
        made.mkdir(mode=0o700)
    except OSError as err:
        raise ExportError(f"{made}: cannot be created: {err.strerror}") from err
    exporter = Exporter(
        made,
        {**settings, "surfaces": True},
        ExportConfig(objects=True, preview=True, cloud="ply", graph=True),
    )
    exporter.write(result)
    images = {"color": cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR), "depth": frame.depth_mm}
    for name, image in images.items():
        path = made / f"{frame.index:06d}_{name}.png"
        try:
            written = cv2.imwrite(str(path), image)
        except cv2.error:
            written = False
        if not written:
            raise ExportError(f"{path}: cannot be written")
    return made
