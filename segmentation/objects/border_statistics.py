"""Statistics of the border of two surfaces: whether they touch, and how concave the crease is."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, I32, compiled
from nurbseg.segmentation.config import REFERENCE_WIDTH
from nurbseg.segmentation.points.normals import plane_normals
from nurbseg.segmentation.points.rays import Rays

#: Largest number of pixels without depth across which surfaces are compared, and distance inside the border
#: at which they are evaluated; in pixels of a 640-wide image.
_REACH_PX = 6
_INSET_PX = 4
#: Least number of touching samples of a border in contact, and least share of all samples.
_TOUCHING_LEAST = 4
_TOUCHING_SHARE = 0.1
#: Limit of the distance of surfaces at a sample, in gaps.
_APART_MOST = 4.0

_Values = NDArray[np.float64]
#: Returns inverse depth and its slopes from labels, columns and rows.
Evaluation = Callable[[NDArray[np.int32], _Values, _Values], tuple[_Values, _Values, _Values]]


@dataclass(frozen=True, slots=True, eq=False)
class BorderStatistics:
    """Statistics of the common borders of P pairs of labels.

    Parameters
    ----------
    labels : (P, 2) int64
        Of each pair, the smaller one first; pairs ascend.
    samples : (P,) float64
        Grid pixels along the border where a row or column crosses it.
    touching : (P,) float64
        Samples where the tangent planes of both surfaces, extrapolated to the border, agree.
    concavity, concavity_square : (P,) float64
        Sums over the touching samples of the angle between the normals, about radians, and of its square;
        the angle is positive at a concave crease, negative at a convex one.
    apart : (P,) float64
        Sum over all samples of the distance of the tangent planes, in gaps, at most 4.
    """

    labels: NDArray[np.int64]
    samples: NDArray[np.float64]
    touching: NDArray[np.float64]
    concavity: NDArray[np.float64]
    concavity_square: NDArray[np.float64]
    apart: NDArray[np.float64]

    @property
    def in_contact(self) -> NDArray[np.bool_]:
        """Whether enough samples of each border touch, in number and as a share of all, (P,) bool."""
        return (self.touching >= _TOUCHING_LEAST) & (self.touching >= _TOUCHING_SHARE * self.samples)


def border_statistics(
    labels: NDArray[np.int32], evaluate: Evaluation, rays: Rays, *, gap_per_m: float, step: int = 1
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
    step : int
        Pixels of the image from one row or column of the labels to the next.

    Returns
    -------
    BorderStatistics
        Of all pairs of labels whose borders meet. Each row or column counts as `step` samples.
    """
    unit = labels.shape[1] / REFERENCE_WIDTH
    crossings = _crossings(labels, max(1, round(_REACH_PX * unit)))
    if crossings.size == 0:
        return BorderStatistics(np.zeros((0, 2), dtype=np.int64), *np.zeros((5, 0)))
    # Both surfaces are evaluated inside of the border: first the one before it, then the one after.
    label, u, v = _inside(crossings, max(1.0, _INSET_PX * unit), step)
    slopes = evaluate(label, u, v)
    ray = rays.at(u, v)
    normals = plane_normals(*slopes, *ray, rays.focal_px)
    sums = step * _compared(crossings, u, v, slopes, ray, normals, gap_per_m, step, int(label.max()) + 1)
    first, second = np.nonzero(sums[..., 0])
    return BorderStatistics(np.stack([first, second], axis=1), *sums[first, second].T.copy())


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
def _inside(crossings: I32, inset: float, step: int) -> tuple[I32, F64, F64]:
    """Return labels and image columns and rows inside both sides of each crossing, those before it first."""
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
    return label, step * u, step * v


@compiled
def _compared(
    crossings: I32,
    u: F64,
    v: F64,
    slopes: tuple[F64, F64, F64],
    ray: tuple[F64, F64],
    normals: F64,
    gap_per_m: float,
    step: int,
    size: int,
) -> F64:
    """Sum by pair of labels: crossings, touching ones, their concavities, the squares of these, gaps."""
    (depth, along_u, along_v), (x, y), count = slopes, ray, u.size // 2
    sums = np.zeros((size, size, 5))
    for n in range(count):
        before, after, row, column, apart = crossings[:, n]
        own, m = sums[min(before, after), max(before, after)], n + count
        # The tangent planes halfway between the surfaces.
        middle_u, middle_v = step * (column + 0.5 * max(apart, 0)), step * (row + 0.5 * max(-apart, 0))
        one = depth[n] + along_u[n] * (middle_u - u[n]) + along_v[n] * (middle_v - v[n])
        other = depth[m] + along_u[m] * (middle_u - u[m]) + along_v[m] * (middle_v - v[m])
        gaps = abs(one - other) / gap_per_m
        own[0] += 1.0
        own[4] += gaps if gaps < _APART_MOST else _APART_MOST
        if not gaps < 1.0:
            continue
        z, z_m = 1.0 / depth[n], 1.0 / depth[m]
        chord = (x[m] * z_m - x[n] * z, y[m] * z_m - y[n] * z, z_m - z)
        turn = square = 0.0
        for axis in range(3):
            turn -= (normals[m, axis] - normals[n, axis]) * chord[axis]
            square += chord[axis] * chord[axis]
        concavity = turn / max(np.sqrt(square), 1e-9)
        own[1] += 1.0
        if abs(concavity) < np.inf:
            own[2] += concavity
            own[3] += concavity * concavity
    return sums
