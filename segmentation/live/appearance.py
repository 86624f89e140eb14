"""Appearance of segments, by which they are recognized after they were hidden."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, U8, U16, Intp, compiled, inlined
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
#: A segment of this frame or of one shortly before: its identity, and the one that it was split from, or 0;
#: frames since it was seen (0 while visible); size and color of when more of it was seen; its center and its
#: motion from frame to frame (meters); then center and color of when most of it was seen, and the next unused
#: identity then.
KNOWN = np.dtype(
    [
        ("identity", "i8"),
        ("whole", "i8"),
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


@inlined
def see_again(known: Any, seen: Any) -> bool:
    """Update what is known of a segment, or of a new one, with what is seen of it; whether it is its best."""
    is_new, is_full = known["pixels"] == 0, seen["pixels"] >= _SIZE_KEPT * known["pixels"]
    for axis in range(3):
        step_m = (seen["center_m"][axis] - known["center_m"][axis]) / (known["unseen"] + 1)
        known["motion_m"][axis] += 0.0 if is_new else _NEW_SHARE * (step_m - known["motion_m"][axis])
        known["center_m"][axis] = seen["center_m"][axis]
        known["color_lab"][axis] = seen["color_lab"][axis] if is_full else known["color_lab"][axis]
    known["unseen"] = 0
    known["pixels"] = seen["pixels"] if is_full else np.int64(np.rint(_SIZE_KEPT * known["pixels"]))
    is_best = bool(seen["pixels"] >= known["pixels"])
    if is_best:
        known["best_center_m"][:], known["best_color_lab"][:] = seen["center_m"], seen["color_lab"]
    return is_best


@inlined
def _distance(one: F64, other: F64) -> float:
    return math.sqrt((one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2)


@inlined
def _difference(color_lab: float, distance_m: float, center_m: F64, times: float) -> float:
    """Judge color and distance together; at most 1 where a segment may be the one that was at this center."""
    reach = (_RETURN_M + _RETURN_SHARE * math.sqrt((center_m * center_m).sum())) * times
    return math.hypot(color_lab / _RETURN_LAB, distance_m / reach) / math.sqrt(2.0)


@inlined
def place_difference(seen: Any, known: Any) -> float:
    """Compare place and color with those of a lost segment that does not move: at most 1 if it may be it."""
    color_lab = _distance(seen["color_lab"], known["best_color_lab"])
    return _difference(
        color_lab, _distance(seen["center_m"], known["best_center_m"]), known["best_center_m"], 1.0
    )


@inlined
def path_difference(seen: Any, known: Any) -> float:
    """Compare size, color and place with those of a lost segment on its path: at most 1 if it may be it."""
    ratio = seen["pixels"] / max(1, known["pixels"])
    if ratio < 1.0 / _RETURN_SMALLER or ratio > _RETURN_LARGER:
        return np.inf
    path = known["motion_m"] * (known["unseen"] + 1)
    share = ((seen["center_m"] - known["center_m"]) * path).sum() / max((path * path).sum(), 1e-12)
    distance_m = _distance(seen["center_m"], known["center_m"] + min(max(share, 0.0), 1.0) * path)
    color_lab = _distance(seen["color_lab"], known["color_lab"])
    # Hidden segments may change their motion.
    return _difference(color_lab, distance_m, known["center_m"], 1.0 + 0.2 * known["unseen"])
