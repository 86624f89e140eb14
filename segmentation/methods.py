"""Segmentation by the method that is set."""

import time

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.frame import segment_nurbseg
from nurbseg.segmentation.growth import Clock
from nurbseg.segmentation.judged import Observer, unobserved
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree


def segment(
    cloud: PointMap,
    config: SegmentationConfig,
    *,
    clock: Clock = time.perf_counter,
    observe: Observer = unobserved,
) -> SegmentationTree:
    """Segment a frame by the method that is set.

    Parameters
    ----------
    cloud : PointMap
        Points and their colors.
    config : SegmentationConfig
        Settings; the same seed gives the same tree, unless a time budget ends it.
    clock : callable
        Returns the time, seconds, by which a time budget is measured.
    observe : callable
        Called with every split that is judged, also with those that are rejected.

    Returns
    -------
    SegmentationTree
        Every segment with its surface, metrics, ratio and, for a leaf, its stop reason. A frame with too few
        points is one leaf.
    """
    if config.method == "stag15":
        from nurbseg.segmentation.stag15 import segment_stag15

        return segment_stag15(cloud, config, clock=clock, observe=observe)
    return segment_nurbseg(cloud, config, clock=clock, observe=observe)
