"""Appearance of segments, by which they are recognized after they were hidden."""

import math

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, U8, U16, Intp, compiled
from nurbseg.segmentation.cut.features import lab
from nurbseg.segmentation.labels.images import read_only
from nurbseg.segmentation.points.registration import PointMap

#: Limits of a returning segment: distance from its path (meters, and share of its depth), times larger or
#: smaller (it may reappear gradually), and color difference (CIELab). Distance and color are judged together:
#: more of one is allowed with less of the other.
_RETURN_M, _RETURN_SHARE, _RETURN_LARGER, _RETURN_SMALLER, _RETURN_LAB = 0.05, 0.05, 3.0, 12.0, 20.0
#: Weight of the last frame in the remembered motion.
_NEW_SHARE = 0.5
#: Decay of a remembered size, and its color, in frames that show less.
_SIZE_KEPT = 0.97

#: A segment of a frame: its label, the number of its pixels on the coarse grid, their mean point (meters) and
#: mean color (CIELab).
SEEN = np.dtype([("label", "i8"), ("pixels", "i8"), ("center_m", "f8", 3), ("color_lab", "f8", 3)])
#: A segment of this frame or of one shortly before: its identity, frames since it was seen (0 while visible),
#: size and color of when more of it was seen, its center and its motion from frame to frame (meters); then
#: center and color of when most of it was seen, and the next unused identity then.
KNOWN = np.dtype(
    [
        ("identity", "i8"),
        ("unseen", "i8"),
        ("pixels", "i8"),
        ("color_lab", "f8", 3),
        ("center_m", "f8", 3),
        ("motion_m", "f8", 3),
        ("best_center_m", "f8", 3),
        ("best_color_lab", "f8", 3),
        ("best_next_identity", "i8"),
    ]
)


def seen_segments(
    labels: NDArray[np.uint16], whole: NDArray[np.uint16], cloud: PointMap, step: int
) -> np.ndarray:
    """Describe the segments of a frame by every few rows and columns, or by all where these miss one.

    Parameters
    ----------
    labels : (H, W) uint16
        Of the frame.
    whole : (N,) uint16
        The segment that each label is, or is a part of; 0 is none.
    cloud : PointMap
        The frame.
    step : int
        Pixels from one row or column to the next.

    Returns
    -------
    (S,) SEEN
        Ascending by label; those that do not occur are left out.
    """
    image, index = read_only(labels), whole.astype(np.intp)
    sums = np.zeros((int(whole.max(initial=0)) + 1, 7))
    _sum_points(image, cloud.points_m, cloud.color, step, index, sums)
    is_missed = sums[:, 0] == 0
    is_missed[0] = False
    if is_missed[index].any():
        _sum_points(image, cloud.points_m, cloud.color, 1, np.where(is_missed[index], index, -1), sums)
    sums[0] = 0.0
    (present,) = sums[:, 0].nonzero()
    counts, means = sums[present, 0], sums[present, 1:] / sums[present, :1]
    seen = np.empty(present.size, SEEN)
    seen["label"], seen["pixels"], seen["center_m"] = present, counts, means[:, :3]
    seen["color_lab"] = lab(np.rint(means[:, 3:]).astype(np.uint8))
    return seen


@compiled
def _sum_points(labels: U16, points_m: F32, color: U8, step: int, index: Intp, sums: F64) -> None:
    """Count pixels, and sum their points and colors, by the index of their label."""
    height, width = color.shape[:2]
    for r in range(0, height, step):
        for c in range(0, width, step):
            label = labels[r * width + c]
            if label >= index.size or index[label] < 0:
                continue
            own = sums[index[label]]
            own[0] += 1.0
            for axis in range(3):
                own[1 + axis] += points_m[r, c, axis]
                own[4 + axis] += color[r, c, axis]


def updated(known: np.ndarray, rows: NDArray[np.intp], seen: np.ndarray) -> np.ndarray:
    """Return what is known of segments with what is seen of them now.

    Parameters
    ----------
    known : (K,) KNOWN
        Until now.
    rows : (S,) intp
        Of the segments; -1 for a new one.
    seen : (S,) SEEN
        The segments now.

    Returns
    -------
    (S,) KNOWN
        With size and color of when more of a segment was seen; identities of new ones are 0.
    """
    before = np.zeros(seen.size, KNOWN)
    (old,) = (rows >= 0).nonzero()
    before[old] = known[rows[old]]
    found = before.copy()
    step_m = (seen["center_m"] - before["center_m"]) / (before["unseen"] + 1)[:, np.newaxis]
    found["motion_m"][old] += (_NEW_SHARE * (step_m - before["motion_m"]))[old]
    found["center_m"], found["unseen"] = seen["center_m"], 0
    is_full = seen["pixels"] >= _SIZE_KEPT * before["pixels"]
    found["pixels"] = np.where(is_full, seen["pixels"], np.rint(_SIZE_KEPT * before["pixels"]))
    found["color_lab"][is_full] = seen["color_lab"][is_full]
    return found


def place_differences(seen: np.ndarray, known: np.ndarray) -> NDArray[np.float64]:
    """Compare place and color of segments, (N,) SEEN, with those of lost ones that do not move, (N,) KNOWN.

    The difference of each pair, (N,) float64, is at most 1 where one may be the other.
    """
    color = _length(seen["color_lab"] - known["best_color_lab"]) / _RETURN_LAB
    reach = _RETURN_M + _RETURN_SHARE * _length(known["best_center_m"])
    return np.hypot(color, _length(seen["center_m"] - known["best_center_m"]) / reach) / math.sqrt(2.0)


def path_differences(seen: np.ndarray, known: np.ndarray) -> NDArray[np.float64]:
    """Compare size, color and place of new segments with those of lost ones on their path.

    Parameters
    ----------
    seen : (S,) SEEN
        The new ones.
    known : (K,) KNOWN
        The lost ones.

    Returns
    -------
    (S, K) float64
        Differences: at most 1 where one may be the other.
    """
    seen = seen[:, np.newaxis]
    ratio = seen["pixels"] / np.maximum(1, known["pixels"])
    color = _length(seen["color_lab"] - known["color_lab"]) / _RETURN_LAB
    # Hidden segments may change their motion.
    reach = (_RETURN_M + _RETURN_SHARE * _length(known["center_m"])) * (1.0 + 0.2 * known["unseen"])
    away = seen["center_m"] - known["center_m"]
    path = known["motion_m"] * (known["unseen"] + 1)[:, np.newaxis]
    share = (away * path).sum(axis=-1) / np.maximum(np.square(path).sum(axis=-1), 1e-12)
    distance = _length(away - share.clip(0.0, 1.0)[..., np.newaxis] * path) / reach
    is_size = (ratio >= 1.0 / _RETURN_SMALLER) & (ratio <= _RETURN_LARGER)
    return np.where(is_size, np.hypot(distance, color) / math.sqrt(2.0), np.inf)


def _length(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.square(vectors).sum(axis=-1)))
