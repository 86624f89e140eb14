"""The scores of one segmentation of one frame."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.evaluation.scoring.objects import ObjectScores, object_scores, without_background
from nurbseg.evaluation.scoring.regions import Contingency, boundary_scores


class FrameScores(NamedTuple):
    """Scores of a label map against the ground truth."""

    #: Rand index and ground-truth region covering, 0 to 1, greater is better.
    ri: float
    gtrc: float
    #: Variation of information, bits, smaller is better.
    voi: float
    #: Mean best IoU over the ground-truth regions except the largest; NaN if there is only one.
    obj: float
    #: Number of segments and of ground-truth regions.
    segments: int
    regions: int
    #: The two parts of `voi`, bits: over- and under-segmentation.
    over: float
    under: float
    #: Of boundaries within 2 pixels; NaN if there are none.
    precision: float
    recall: float


def score_objects(
    labels: NDArray[np.integer],
    truth: NDArray[np.integer],
    points_m: NDArray[np.float32],
    pieces: int = 1,
) -> ObjectScores:
    """Score the objects of a segmentation, over pixels that have depth and ground truth.

    Parameters
    ----------
    labels : (H, W) integer
        Segments; 0 is none. The largest, and those coplanar with it, are the background.
    truth : (H, W) integer
        Ground truth; 0 is none.
    points_m : (H, W, 3) float32
        Points, meters; NaN if there is none.
    pieces : int
        A ground-truth label divided by this, rounded down, is an object, and 0 is the background. With 1,
        labels are objects, and the largest region is the background.

    Returns
    -------
    ObjectScores
        Of all objects but the background.
    """
    counted = np.isfinite(points_m[..., 2]) & (truth > 0)
    known = np.where(counted, truth.astype(np.int64), 0)
    if pieces == 1:
        known[known == np.bincount(known[counted]).argmax()] = 0
    judged = np.where(counted, labels.astype(np.int64), 0)
    return object_scores(without_background(judged, points_m), known // pieces)


#: Heading of each score in the tables, and whether greater is better.
SCORES = {
    "ri": ("RI", True),
    "gtrc": ("GTRC", True),
    "voi": ("VoI (bits)", False),
    "obj": ("obj", True),
}


def score_frame(
    labels: NDArray[np.integer], truth: NDArray[np.integer], valid: NDArray[np.bool_]
) -> FrameScores:
    """Score a segmentation against the ground truth, over pixels that have depth and ground truth.

    Pixels that have both but no label (0) count as one more segment, so that leaving pixels out does not
    raise the scores.

    Parameters
    ----------
    labels : (H, W) integer
        Segments; 0 is none.
    truth : (H, W) integer
        Ground truth; 0 is none.
    valid : (H, W) bool
        Where there is depth.

    Raises
    ------
    ValueError
        If the shapes differ or no pixel counts.
    """
    if labels.shape != truth.shape:
        raise ValueError(f"labels: expected the ground truth's {truth.shape}, got {labels.shape}")
    counted = valid & (truth > 0)
    judged = np.where(counted, labels.astype(np.int64) + 1, 0)
    known = np.where(counted, truth, 0)
    table = Contingency.between(judged, known)
    edges = boundary_scores(judged, known)
    segments, regions = table.pixels.shape
    return FrameScores(
        ri=table.rand_index(),
        gtrc=table.region_covering(),
        voi=table.variation_of_information(),
        obj=table.object_iou(),
        segments=segments,
        regions=regions,
        over=table.over_segmentation_bits(),
        under=table.under_segmentation_bits(),
        precision=edges.precision,
        recall=edges.recall,
    )
