"""What is done with one frame, in the method's order."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from nurbseg.drivers.frame import RGBDFrame
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.registration import PointMap, register
from nurbseg.segmentation.tree import SegmentationTree, segment


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """A frame and what came of it.

    Parameters
    ----------
    frame : RGBDFrame
        As it was captured.
    cloud : PointMap
        Its points with their colors.
    tree : SegmentationTree
        Its segments.
    elapsed_ms : mapping of str to float
        Time that each stage took, milliseconds.
    """

    frame: RGBDFrame
    cloud: PointMap
    tree: SegmentationTree
    elapsed_ms: Mapping[str, float]


def process_frame(frame: RGBDFrame, config: SegmentationConfig) -> FrameResult:
    """Register and segment one frame.

    Parameters
    ----------
    frame : RGBDFrame
        Depth and color.
    config : SegmentationConfig
        How to segment.

    Returns
    -------
    FrameResult
        With the stages ``register`` and ``segment``.
    """
    started_s = time.perf_counter()
    cloud = register(frame)
    registered_s = time.perf_counter()
    tree = segment(cloud, config)
    segmented_s = time.perf_counter()
    elapsed_ms = {
        "register": 1e3 * (registered_s - started_s),
        "segment": 1e3 * (segmented_s - registered_s),
    }
    return FrameResult(frame, cloud, tree, MappingProxyType(elapsed_ms))
