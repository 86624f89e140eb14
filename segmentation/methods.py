"""The methods, by the setting that chooses between them."""

from __future__ import annotations

from nurbseg.segmentation.blas import one_blas_thread
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.splitting import segment_nurbseg
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.stag15 import segment_stag15


def segment(cloud: PointMap, config: SegmentationConfig) -> SegmentationTree:
    """Segment a frame by the method that is set.

    Parameters
    ----------
    cloud : PointMap
        Points and their colors.
    config : SegmentationConfig
        Thresholds and choices; the same seed gives the same tree.

    Returns
    -------
    SegmentationTree
        Every segment with its surface, metrics, ratio and, for a leaf, the reason why it is one. A frame
        with too few points is one leaf.
    """
    if config.method == "stag15":
        return segment_stag15(cloud, config)
    with one_blas_thread():
        return segment_nurbseg(cloud, config)
