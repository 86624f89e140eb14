"""Appearance of segments, by which they are recognized after they were hidden."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I64, U8, U16, compiled
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


#: A point or a color: single numbers, as arrays of three cost ten times as much.
Triple: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """By which a segment is recognized after it was hidden.

    Parameters
    ----------
    center_m : (float, float, float)
        Mean of its points, meters.
    color_lab : (float, float, float)
        Its mean color, CIELab.
    pixels : int
        Number of its pixels on the grid.
    unseen : int
        Frames since it was seen; 0 while visible.
    motion_m : (float, float, float)
        Its motion from frame to frame, meters.
    """

    center_m: Triple
    color_lab: Triple
    pixels: int
    unseen: int = 0
    motion_m: Triple = (0.0, 0.0, 0.0)

    def distance_m(self, center_m: Triple) -> float:
        """Return the distance of a point from its path to the next frame, meters."""
        (x, y, z), frames = self.motion_m, self.unseen + 1
        x, y, z = x * frames, y * frames, z * frames
        a, b, c = (there - here for there, here in zip(center_m, self.center_m, strict=True))
        share = (a * x + b * y + c * z) / max(x * x + y * y + z * z, 1e-12)
        share = min(max(share, 0.0), 1.0)
        return math.hypot(a - share * x, b - share * y, c - share * z)


def updated(before: Appearance | None, now: Appearance) -> Appearance:
    """Return the appearance now, but with size and color of when more of it was seen."""
    if before is None:
        return now
    x, y, z = (
        motion + _NEW_SHARE * ((there - here) / (before.unseen + 1) - motion)
        for there, here, motion in zip(now.center_m, before.center_m, before.motion_m, strict=True)
    )
    if now.pixels >= _SIZE_KEPT * before.pixels:
        return Appearance(now.center_m, now.color_lab, now.pixels, 0, (x, y, z))
    pixels = round(_SIZE_KEPT * before.pixels)
    return Appearance(now.center_m, before.color_lab, pixels, 0, (x, y, z))


def appearances_of(
    labels: NDArray[np.uint16],
    whole: NDArray[np.uint16],
    wanted: Sequence[int] | NDArray[np.uint16],
    cloud: PointMap,
    step: int,
) -> dict[int, Appearance]:
    """Describe some segments by every few rows and columns of a frame.

    Parameters
    ----------
    labels : (H, W) uint16
        Of the frame.
    whole : (N,) uint16
        The segment that each label is, or is a part of.
    wanted : sequence of int
        Segments, ascending; those that do not occur are left out.
    cloud : PointMap
        The frame.
    step : int
        Pixels from one row or column to the next.
    """
    sums = np.zeros((len(wanted), 7))
    index = np.full(int(whole.max(initial=0)) + 1, -1)
    index[wanted] = np.arange(len(wanted))
    _sum_points(read_only(labels), cloud.points_m, cloud.color, step, index[whole], sums)
    counts = sums[:, 0]
    means = sums[:, 1:] / np.maximum(counts, 1.0)[:, np.newaxis]
    colors = lab(np.rint(means[:, 3:]).astype(np.uint8)).astype(np.float64)
    columns = (np.asarray(wanted), counts.astype(np.int64), means[:, :3], colors)
    return {
        label: Appearance((x, y, z), (light, green_red, blue_yellow), count)
        for label, count, (x, y, z), (light, green_red, blue_yellow) in zip(
            *(column.tolist() for column in columns), strict=True
        )
        if label and count
    }


@compiled
def _sum_points(labels: U16, points_m: F32, color: U8, step: int, index: I64, sums: F64) -> None:
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


def looks_like(appearance: Appearance, other: Appearance) -> bool:
    """Return whether a segment may be another one that does not move, by its place and color."""
    color = math.dist(appearance.color_lab, other.color_lab) / _RETURN_LAB
    reach = _RETURN_M + _RETURN_SHARE * math.hypot(*other.center_m)
    return math.hypot(color, math.dist(appearance.center_m, other.center_m) / reach) <= math.sqrt(2.0)


def best_match(appearance: Appearance, lost: Mapping[int, Appearance]) -> int | None:
    """Return the lost identity that a segment resembles most, if any."""
    best: tuple[float, int] | None = None
    for identity, other in lost.items():
        ratio = appearance.pixels / max(1, other.pixels)
        color = math.dist(appearance.color_lab, other.color_lab) / _RETURN_LAB
        if not 1.0 / _RETURN_SMALLER <= ratio <= _RETURN_LARGER or color > math.sqrt(2.0):
            continue
        reach = _RETURN_M + _RETURN_SHARE * math.hypot(*other.center_m)
        # Hidden segments may change their motion.
        reach *= 1.0 + 0.2 * other.unseen
        distance = other.distance_m(appearance.center_m) / reach
        difference = math.hypot(distance, color)
        if difference <= math.sqrt(2.0) and (best is None or difference < best[0]):
            best = difference, identity
    return None if best is None else best[1]
