"""Where two surfaces meet: whether they touch, and how concave the crease between them is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled
from nurbseg.segmentation.points.rays import Rays
from nurbseg.segmentation.surfaces.surface import NurbsSurface
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

#: Surfaces are compared across so many pixels without depth, at most, and by their points and normals so
#: many pixels inside their border; both in pixels of an image 640 wide.
_REACH_PX = 6
_INSET_PX = 4
#: Surfaces are in contact where so many samples of their border touch, and such a share of all.
_TOUCHING_LEAST = 4
_TOUCHING_SHARE = 0.5

_Values = NDArray[np.float64]
#: Gives inverse depth and its slopes from labels, columns and rows.
Evaluation = Callable[[NDArray[np.int32], _Values, _Values], tuple[_Values, _Values, _Values]]


@dataclass(frozen=True, slots=True)
class BorderStatistics:
    """What was measured along the common border of two labels.

    Parameters
    ----------
    first, second : int
        Labels, the smaller one first.
    samples : int
        Places along the border where a row or column crosses it.
    touching : int
        Samples where the tangent planes of both surfaces, extrapolated to the border, agree.
    concavity_sum : float
        Sum over the touching samples of the turn of the normals towards each other, about radians: more
        than 0 where the crease is concave, less where it is convex.
    """

    first: int
    second: int
    samples: int
    touching: int
    concavity_sum: float


def in_contact(samples: float, touching: float) -> bool:
    """Say whether enough samples of a common border touch, in number and as a share of all."""
    return touching >= _TOUCHING_LEAST and touching >= _TOUCHING_SHARE * samples


def border_statistics(
    labels: NDArray[np.int32],
    surfaces: Sequence[NurbsSurface | None],
    rays: Rays,
    *,
    gap_per_m: float,
    evaluate: Evaluation | None = None,
) -> tuple[BorderStatistics, ...]:
    """Measure every common border of two labels.

    Parameters
    ----------
    labels : (H, W) int32
        1 to the number of surfaces; 0 where there is no point.
    surfaces : sequence of NurbsSurface or None
        That of each label; a label without one touches nothing.
    rays : Rays
        Of the camera.
    gap_per_m : float
        Tangent planes that differ by less inverse depth at the border agree, 1/m.
    evaluate : callable, optional
        Takes labels, columns and rows (pixels), (N,) each; gives inverse depth and its slopes along both,
        NaN where a label has no surface. By default the surfaces themselves are evaluated.

    Returns
    -------
    tuple of BorderStatistics
        In ascending order of their labels.
    """
    unit = labels.shape[1] / 640.0
    crossings = np.empty((5, 2 * labels.size), dtype=np.int32)
    count = _find_crossings(np.ascontiguousarray(labels), max(1, round(_REACH_PX * unit)), crossings)
    if count == 0:
        return ()
    crossings = np.ascontiguousarray(crossings[:, :count])
    # Both surfaces are looked at inside of the border: first all places before it, then all behind.
    label, u, v = crossings[:2].ravel(), np.empty((2, count)), np.empty((2, count))
    _step_inside(crossings, max(1.0, _INSET_PX * unit), u, v)
    per_m, slope_u, slope_v = (evaluate or SurfaceTable(surfaces).slopes)(label, u.ravel(), v.ravel())
    x, y = rays.at(u.ravel(), v.ravel())
    places = np.stack([u.ravel(), v.ravel(), x, y, per_m, slope_u, slope_v]).reshape(7, 2, count)

    borders = _no_borders(int(label.max()), count)
    last = _measure(crossings, places, rays.focal_px, gap_per_m, borders)
    rows = zip(*(each[1 : last + 1].tolist() for each in borders[2:]), strict=True)
    return tuple(BorderStatistics(*row) for row in sorted(rows))


@compiled
def _find_crossings(labels: NDArray[np.int32], reach: int, found: NDArray[np.int32]) -> int:
    """Find where rows and columns go from one label to another, over `reach` pixels at most.

    Writes to a column of `found` for each: label before and after, row and column of the last pixel before,
    and pixels from the one to the other, along the row if more than 0 and else down the column. Returns
    how many there are.
    """
    height, width = labels.shape
    count = 0
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
    return count


@compiled
def _pixels_to_next(labels: NDArray[np.int32]) -> int:
    """Return how far the first pixel is from another label, over what has none; 0 where it is its own."""
    for apart in range(1, labels.size):
        if labels[apart] > 0:
            return apart if labels[apart] != labels[0] else 0
    return 0


@compiled
def _step_inside(
    crossings: NDArray[np.int32], inset: float, u: NDArray[np.float64], v: NDArray[np.float64]
) -> None:
    """Say where both surfaces of each crossing are looked at, (2, N) columns u and rows v."""
    for n in range(crossings.shape[1]):
        row, column, apart = crossings[2, n], crossings[3, n], crossings[4, n]
        u[0, n] = u[1, n] = column
        v[0, n] = v[1, n] = row
        if apart > 0:
            u[0, n], u[1, n] = column - inset, column + (apart + inset)
        else:
            v[0, n], v[1, n] = row - inset, row + (inset - apart)


class _Borders(NamedTuple):
    """What is measured, by border from number 1 on.

    Parameters
    ----------
    newest : (labels + 1,) int32
        Of each label the newest border with a larger one, 0 for none.
    older : (N + 1,) int32
        The one before with the same smaller label, 0 for none.
    first, second, samples, touching, concavity_sum : (N + 1,)
        As those of a `BorderStatistics`.
    """

    newest: NDArray[np.int32]
    older: NDArray[np.int32]
    first: NDArray[np.int32]
    second: NDArray[np.int32]
    samples: NDArray[np.int32]
    touching: NDArray[np.int32]
    concavity_sum: NDArray[np.float64]


def _no_borders(label_most: int, count: int) -> _Borders:
    """Return room for as many borders as there are crossings."""
    newest = np.zeros(label_most + 1, dtype=np.int32)
    older, first, second, samples, touching = np.zeros((5, count + 1), dtype=np.int32)
    return _Borders(newest, older, first, second, samples, touching, np.zeros(count + 1))


@compiled
def _measure(
    crossings: NDArray[np.int32],
    places: NDArray[np.float64],
    focal_px: tuple[float, float],
    gap_per_m: float,
    borders: _Borders,
) -> int:
    """Add crossings up by border; `places` (7, 2, N) are u, v, rays x, y, inverse depth and its slopes.

    Returns the number of borders.
    """
    u, v, ray_x, ray_y, per_m, slope_u, slope_v = places
    last = 0
    points, normals, at_border = np.empty((2, 3)), np.empty((2, 3)), np.empty(2)
    for n in range(crossings.shape[1]):
        one, other = min(crossings[0, n], crossings[1, n]), max(crossings[0, n], crossings[1, n])
        border = borders.newest[one]
        while border > 0 and borders.second[border] != other:
            border = borders.older[border]
        if border == 0:
            last += 1
            border = last
            borders.first[border], borders.second[border] = one, other
            borders.older[border], borders.newest[one] = borders.newest[one], border
        borders.samples[border] += 1

        # The tangent planes at the middle of what is between the surfaces.
        apart = crossings[4, n]
        middle_u = crossings[3, n] + 0.5 * max(apart, 0)
        middle_v = crossings[2, n] + 0.5 * max(-apart, 0)
        for side in range(2):
            at_border[side] = (
                per_m[side, n]
                + slope_u[side, n] * (middle_u - u[side, n])
                + slope_v[side, n] * (middle_v - v[side, n])
            )
        if not abs(at_border[0] - at_border[1]) < gap_per_m:
            continue
        borders.touching[border] += 1
        for side in range(2):
            x, y, d = ray_x[side, n], ray_y[side, n], per_m[side, n]
            points[side, 0], points[side, 1], points[side, 2] = x / d, y / d, 1.0 / d
            # As for the normals of facets.
            nx, ny = slope_u[side, n] * focal_px[0], slope_v[side, n] * focal_px[1]
            nz = d - nx * x - ny * y
            towards = -1.0 / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
            normals[side, 0], normals[side, 1], normals[side, 2] = nx * towards, ny * towards, nz * towards
        square, turn = 0.0, 0.0
        for axis in range(3):
            apart_m = points[1, axis] - points[0, axis]
            square += apart_m * apart_m
            turn -= (normals[1, axis] - normals[0, axis]) * apart_m
        concavity = turn / max(np.sqrt(square), 1e-9)
        if abs(concavity) < np.inf:
            borders.concavity_sum[border] += concavity
    return last


__all__ = ["BorderStatistics", "Evaluation", "border_statistics", "in_contact"]
