"""A tilted wall with a box before it, small enough to be segmented in no time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import SegmentationConfig, Stag15Config

WIDTH, HEIGHT = 160, 120
CONFIG = SegmentationConfig(decimation=1, samples=50, stag15=Stag15Config(segment_pixels_min=400))


def small_frame(index: int = 0, *, calibration: Calibration | None = None, truth: bool = True) -> RGBDFrame:
    """Return a frame; the box moves to the right with the index, and the left edge has no depth."""
    camera = Intrinsics(WIDTH, HEIGHT, 131.0, 131.0, 79.5, 59.5)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    depth_mm = 1800.0 + 2.0 * columns + 1.0 * rows
    left = 50 + 2 * (index % 10)
    box = np.zeros((HEIGHT, WIDTH), dtype=bool)
    box[35:85, left : left + 45] = True
    depth_mm[box] = 1100.0
    depth_mm[:, :4] = 0.0
    color = np.full((HEIGHT, WIDTH, 3), (90, 110, 160), dtype=np.uint8)
    color[box] = (210, 120, 40)
    labels = np.where(box, 2, 1).astype(np.uint16)
    return RGBDFrame(
        index=index,
        timestamp_ns=index * 33_000_000,
        depth_mm=depth_mm.astype(np.uint16),
        color=color,
        calibration=calibration or Calibration.registered(camera),
        labels=labels if truth else None,
        name=f"small{index}",
    )


def small_result(index: int = 0, *, calibration: Calibration | None = None) -> FrameResult:
    """Return the segmented frame."""
    return process_frame(small_frame(index, calibration=calibration), CONFIG)


def numbered(result: FrameResult, index: int) -> FrameResult:
    """Return a result as that of another frame."""
    return replace(result, frame=replace(result.frame, index=index, timestamp_ns=index * 33_000_000))
