"""A split of a segment that is wanted, whatever its ratio."""

from dataclasses import replace

import numpy as np

from nurbseg.common.computer import one_blas_thread
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.frame import shown_leaves
from nurbseg.segmentation.extended.grid_features import grid_features
from nurbseg.segmentation.extended.parts import fit_segment
from nurbseg.segmentation.extended.splitting import split_segment
from nurbseg.segmentation.points.grid import grid_step
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Segment, depth_first, finished_segments

#: Shares of the minimum segment size that are tried in turn.
_SHARES = (1.0, 0.25, 0.0)
#: The ratio of a split is computed twice, and may be rounded differently.
_ROUNDING = 1e-6


@one_blas_thread()
def split_anyway(cloud: PointMap, segment: Segment, config: SegmentationConfig) -> tuple[Segment, ...]:
    """Split a segment by the first normalized cut that the ratio keeps, or else by that with the least ratio.

    Where all parts would be smaller than the minimum segment size, smaller ones are taken.

    Parameters
    ----------
    cloud : PointMap
        The frame.
    segment : Segment
        A leaf of its tree.
    config : SegmentationConfig
        Settings of the segmentation.

    Returns
    -------
    tuple of Segment
        The segment, divided, and all below it, depth first. Of a segment that cannot be cut it is the only
        one.
    """
    inside = np.zeros(cloud.valid.shape, dtype=np.bool_)
    inside.flat[segment.pixels] = True
    points_m = np.where(inside[..., None], cloud.points_m, np.float32(np.nan))
    own = replace(cloud, points_m=points_m, known_rays=cloud.rays)
    config = replace(config, decimation=grid_step(own.valid, config.decimation))
    features = grid_features(own, config)
    root = fit_segment(features, np.flatnonzero(features.grid.valid), config)
    root.name, root.cuts_above = segment.name, segment.cuts_above
    for share in _SHARES:
        least = max(1, round(share * config.extended.piece_pixels_min))
        config = replace(config, extended=replace(config.extended, piece_pixels_min=least))
        split_segment(features, root, config)
        if not root.children and root.trial is not None and np.isfinite(root.trial.ratio):
            best = root.trial.ratio * (1.0 + _ROUNDING) + _ROUNDING
            split_segment(features, root, replace(config, ratio_max=best))
        if root.children:
            shown = shown_leaves(root, own, features, config)
            return finished_segments(depth_first(root), shown.labels.astype(np.uint16))
    return (segment,)
