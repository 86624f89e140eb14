"""Sums along the borders of surfaces: whether they touch, how concave the crease is, which is in front."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, I32, compiled, inlined
from nurbseg.segmentation.config import REFERENCE_WIDTH
from nurbseg.segmentation.points.normals import plane_normals
from nurbseg.segmentation.points.rays import Rays

#: Largest number of pixels without depth across which surfaces are compared, and distance inside the border
#: at which they are evaluated; in pixels of a 640-wide image.
_REACH_PX = 6
_INSET_PX = 4
#: Limit of the distance of surfaces at a sample, in gaps.
_APART_MOST = 4.0
#: Concavity beyond which a crease is concave, or convex, about radians.
_CREASE_LEAST = 0.15

#: Columns of the sums.
SAMPLES, TOUCHING, CONCAVITY, CONCAVITY_SQUARE, CONVEX, CONCAVE = range(6)
APART, STEP, FIRST_NEARER, SECOND_NEARER = range(6, 10)
#: The first of three columns, one for each axis.
POINT, FIRST_NORMAL, SECOND_NORMAL = 10, 13, 16
#: The number of columns.
SUMS = 19

_Values = NDArray[np.float64]
#: Returns inverse depth and its slopes from labels, columns and rows.
Evaluation = Callable[[NDArray[np.int32], _Values, _Values], tuple[_Values, _Values, _Values]]


@dataclass(frozen=True, slots=True, eq=False)
class BorderStatistics:
    """Sums over the samples of the common borders of P pairs of labels.

    Sums of borders add up: those of merged surfaces are the sums of their parts.

    Parameters
    ----------
    labels : (P, 2) int64
        Of each pair, the smaller one first; pairs ascend.
    sums : (P, 19) float64
        By the columns of this module. `SAMPLES`: grid pixels where a row or column crosses the border.
        `TOUCHING`: those where the tangent planes of both surfaces, extrapolated to the border, agree; over
        these `CONCAVITY`, the angle between the normals, about radians, positive at a concave crease, its
        square, and the numbers of `CONVEX` and `CONCAVE` samples. Over all: `APART`, the distance of the
        tangent planes in gaps, at most 4; `STEP`, the same with a sign, positive where the first is nearer;
        where the first or the second is nearer by more than a gap; `POINT`, the point on the border, meters;
        and both surfaces' normals.
    """

    labels: NDArray[np.int64]
    sums: NDArray[np.float64]


def border_statistics(
    labels: NDArray[np.int32], evaluate: Evaluation, rays: Rays, *, gap_per_m: float
) -> BorderStatistics:
    """Measure every common border of two labels.

    Parameters
    ----------
    labels : (H, W) int32
        1 to the number of surfaces; 0 where there is no point.
    evaluate : callable
        Takes labels, columns and rows (pixels), (N,) each; returns inverse depth and its slopes along both,
        NaN where a label has no surface: it touches nothing.
    rays : Rays
        Of the camera.
    gap_per_m : float
        Tangent planes that differ by less inverse depth at the border agree, 1/m.

    Returns
    -------
    BorderStatistics
        Of all pairs of labels whose borders meet.
    """
    unit = labels.shape[1] / REFERENCE_WIDTH
    crossings = _crossings(labels, max(1, round(_REACH_PX * unit)))
    if crossings.size == 0:
        return BorderStatistics(np.zeros((0, 2), dtype=np.int64), np.zeros((0, SUMS)))
    # Both surfaces are evaluated inside of the border: first the one before it, then the one after.
    label, u, v = _inside(crossings, max(1.0, _INSET_PX * unit))
    slopes = evaluate(label, u, v)
    ray = rays.at(u, v)
    normals = plane_normals(*slopes, *ray, rays.focal_px)
    sums = _compared(crossings, u, v, slopes, ray, normals, gap_per_m, int(label.max()) + 1)
    first, second = np.nonzero(sums[..., SAMPLES])
    return BorderStatistics(np.stack([first, second], axis=1), sums[first, second])


@compiled
def _crossings(labels: I32, reach: int) -> I32:
    """Find where rows and columns go from one label to another, over `reach` pixels at most.

    Each has a column: label before and after, row and column of the last pixel before, and pixels from the
    one to the other, along the row if more than 0 and else down the column.
    """
    height, width = labels.shape
    found, count = np.empty((5, 2 * labels.size), dtype=np.int32), 0
    for row in range(height):
        for column in range(width):
            before = labels[row, column]
            if before == 0:
                continue
            if column + 1 < width and labels[row, column + 1] != before:
                apart = _pixels_to_next(labels[row, column : column + reach + 1])
                if apart > 0:
                    found[0, count], found[1, count] = before, labels[row, column + apart]
                    found[2, count], found[3, count], found[4, count] = row, column, apart
                    count += 1
            if row + 1 < height and labels[row + 1, column] != before:
                apart = _pixels_to_next(labels[row : row + reach + 1, column])
                if apart > 0:
                    found[0, count], found[1, count] = before, labels[row + apart, column]
                    found[2, count], found[3, count], found[4, count] = row, column, -apart
                    count += 1
    return found[:, :count].copy()


@compiled
def _pixels_to_next(labels: I32) -> int:
    """Return the distance from the first pixel to another label across unlabeled ones; 0 if none is next."""
    for apart in range(1, labels.size):
        if labels[apart] > 0:
            return apart if labels[apart] != labels[0] else 0
    return 0


@compiled
def _inside(crossings: I32, inset: float) -> tuple[I32, F64, F64]:
    """Return labels, columns and rows inside both sides of each crossing, those before it first."""
    count = crossings.shape[1]
    label, u, v = np.empty(2 * count, dtype=np.int32), np.empty(2 * count), np.empty(2 * count)
    for n in range(count):
        before, after, row, column, apart = crossings[:, n]
        label[n], label[n + count] = before, after
        u[n], v[n], u[n + count], v[n + count] = column, row, column, row
        if apart > 0:
            u[n], u[n + count] = column - inset, column + apart + inset
        else:
            v[n], v[n + count] = row - inset, row - apart + inset
    return label, u, v


@compiled
def _compared(
    crossings: I32,
    u: F64,
    v: F64,
    slopes: tuple[F64, F64, F64],
    ray: tuple[F64, F64],
    normals: F64,
    gap_per_m: float,
    size: int,
) -> F64:
    """Sum by pair of labels, as `BorderStatistics` has it."""
    (depth, along_u, along_v), (x, y), count = slopes, ray, u.size // 2
    sums = np.zeros((size, size, SUMS))
    for n in range(count):
        before, after, row, column, apart = crossings[:, n]
        first, second = (n, n + count) if before < after else (n + count, n)
        own = sums[min(before, after), max(before, after)]
        # The tangent planes halfway between the surfaces.
        middle_u, middle_v = column + 0.5 * max(apart, 0), row + 0.5 * max(-apart, 0)
        one = depth[first] + along_u[first] * (middle_u - u[first]) + along_v[first] * (middle_v - v[first])
        other = (
            depth[second]
            + along_u[second] * (middle_u - u[second])
            + along_v[second] * (middle_v - v[second])
        )
        gaps = (one - other) / gap_per_m
        own[SAMPLES] += 1.0
        if not abs(gaps) < np.inf:
            own[APART] += _APART_MOST
            continue
        own[APART] += min(abs(gaps), _APART_MOST)
        own[STEP] += max(-_APART_MOST, min(gaps, _APART_MOST))
        if gaps > 1.0:
            own[FIRST_NEARER] += 1.0
        elif gaps < -1.0:
            own[SECOND_NEARER] += 1.0
        z, z_m = 1.0 / depth[first], 1.0 / depth[second]
        from_m = (x[first] * z, y[first] * z, z)
        to_m = (x[second] * z_m, y[second] * z_m, z_m)
        turn = square = 0.0
        for axis in range(3):
            chord = to_m[axis] - from_m[axis]
            turn -= (normals[second, axis] - normals[first, axis]) * chord
            square += chord * chord
            own[POINT + axis] += 0.5 * (from_m[axis] + to_m[axis])
            own[FIRST_NORMAL + axis] += normals[first, axis]
            own[SECOND_NORMAL + axis] += normals[second, axis]
        concavity = turn / max(np.sqrt(square), 1e-9)
        if abs(gaps) < 1.0 and abs(concavity) < np.inf:
            _add_crease(own, concavity)
    return sums


@inlined
def _add_crease(own: F64, concavity: float) -> None:
    own[TOUCHING] += 1.0
    own[CONCAVITY] += concavity
    own[CONCAVITY_SQUARE] += concavity * concavity
    if concavity < -_CREASE_LEAST:
        own[CONVEX] += 1.0
    elif concavity > _CREASE_LEAST:
        own[CONCAVE] += 1.0


@compiled
def add_border(own: F64, border: F64, turned: bool) -> None:
    """Add the sums of a border to those of another; `turned` if its first surface is the other's second."""
    for k in range(FIRST_NEARER):
        own[k] += -border[k] if turned and k == STEP else border[k]
    for axis in range(3):
        own[POINT + axis] += border[POINT + axis]
    nearer = SECOND_NEARER if turned else FIRST_NEARER
    own[FIRST_NEARER] += border[nearer]
    own[SECOND_NEARER] += border[FIRST_NEARER + SECOND_NEARER - nearer]
    normal = SECOND_NORMAL if turned else FIRST_NORMAL
    for axis in range(3):
        own[FIRST_NORMAL + axis] += border[normal + axis]
        own[SECOND_NORMAL + axis] += border[FIRST_NORMAL + SECOND_NORMAL - normal + axis]
