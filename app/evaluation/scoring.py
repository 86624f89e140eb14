"""The scores of one segmentation of one frame, as a flat record."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.scoring.boundaries import boundary_scores
from nurbseg.segmentation.scoring.objects import object_scores, without_background
from nurbseg.segmentation.scoring.scores import Contingency


@dataclass(frozen=True, slots=True)
class FrameScores:
    """How a label map compares with the ground truth.

    Parameters
    ----------
    ri, gtrc : float
        Rand index and ground-truth region covering, 0 to 1, greater is better.
    voi : float
        Variation of information, bits, smaller is better.
    obj : float
        Mean best IoU over the ground-truth regions but the largest; NaN where there is one region.
    segments, regions : int
        Segments found and regions of the ground truth, over the pixels that count.
    over, under : float
        The two halves of `voi`, bits: regions torn into segments, and segments that hold several.
    precision, recall : float
        Of boundaries within 2 pixels; NaN where there are none.
    """

    ri: float
    gtrc: float
    voi: float
    obj: float
    segments: int
    regions: int
    over: float
    under: float
    precision: float
    recall: float

    def as_record(self) -> dict[str, float | int | None]:
        """Return the scores by name, None in place of NaN, which JSON does not know."""
        return {name: None if value != value else value for name, value in asdict(self).items()}


def score_objects(
    labels: NDArray[np.integer],
    truth: NDArray[np.integer],
    points_m: NDArray[np.float32],
    pieces: int = 1,
) -> dict[str, float | None]:
    """Score the objects of a segmentation, over pixels that have depth and ground truth.

    Parameters
    ----------
    labels : (H, W) integer
        Segments; 0 is none. The largest, and what lies in one plane with it, is the background.
    truth : (H, W) integer
        Ground truth; 0 is none.
    points_m : (H, W, 3) float32
        Points, metres; NaN where there is none.
    pieces : int
        An object of the ground truth is its label over this, rounded down, 0 being the background. With 1
        labels are those of objects, and the largest region is the background.

    Returns
    -------
    dict
        Of `ObjectScores`, by name; None in place of NaN.
    """
    counted = np.isfinite(points_m[..., 2]) & (truth > 0)
    known = np.where(counted, truth.astype(np.int64), 0)
    if pieces == 1:
        known[known == np.bincount(known[counted]).argmax()] = 0
    judged = np.where(counted, labels.astype(np.int64), 0)
    scores = object_scores(without_background(judged, points_m), known // pieces)
    return {name: None if value != value else value for name, value in scores._asdict().items()}


#: For each score of the tables: its heading and whether greater is better.
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

    A pixel that has both but bears no label (0) counts as part of one more segment: a method may not
    raise its score by leaving pixels out.

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
    edges = boundary_scores(judged, known, tolerance_px=2.0)
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
