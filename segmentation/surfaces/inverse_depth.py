"""Surfaces fitted to inverse depth: rational splines S = ray / d that hold every plane exactly.

With d(u, v) a spline and the ray (x / z, y / z, 1) a polynomial of the pixel, S = ray(u, v) / d(u, v) is a
NURBS surface: its weights are the control values of d, its weighted control points those of the ray. A plane
n . p = 1 has d = n . ray, linear in the pixel. Triangulating sensors measure d, with constant noise.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import accumulate
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.labels.runs import runs_of_labels, runs_of_pixels, runs_of_union
from nurbseg.segmentation.points.grid import DepthGrid
from nurbseg.segmentation.points.rays import Rays
from nurbseg.segmentation.surfaces.bspline import CUBIC, basis_matrices, lattice
from nurbseg.segmentation.surfaces.cells import (
    FLOOR,
    MEASURES,
    RMS,
    SPLINE,
    UNSOLVED,
    Frame,
    Sets,
    fit_splines,
    lay_out,
    sum_cells,
)
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS, RESIDUAL_METRICS, SQUARE_MOST
from nurbseg.segmentation.surfaces.noise import curvature_floor, floor_weights, knots_on
from nurbseg.segmentation.surfaces.surface import NurbsSurface, unchecked

#: How far the knots of a surface extend beyond its segment, pixels of a 640-wide image.
_MARGIN_PX = 24.0
#: Sets, runs of grid pixels, and cells of the knots that there is room for at first.
_SETS, _RUNS, _CELLS = 256, 1 << 13, 1 << 10

_DEGREE = (CUBIC, CUBIC)

#: Some grid pixels, flat and ascending, and the fit to them.
Fitted = tuple[NDArray[np.intp], Fit]


class DepthFitter:
    """Fits surfaces to the inverse depth of sets of grid pixels of one frame, many sets at once.

    The sums of every set are kept: a surface for several sets together takes no more than a solution of their
    equations.

    Parameters
    ----------
    grid : DepthGrid
        The points.
    config : SegmentationConfig
        Knot spacing and smoothness, noise, and the deciding metric with its limits.

    Attributes
    ----------
    grid : DepthGrid
        The points.

    References
    ----------
    .. [1] P. Eilers and B. Marx, "Flexible smoothing with B-splines and penalties", Statistical Science
       11(2), 1996.
    """

    def __init__(self, grid: DepthGrid, config: SegmentationConfig) -> None:
        self.grid, self._config = grid, config
        (spacing, smoothness), extended, rays = knots_on(grid, config), config.extended, grid.rays
        self._is_linear = rays.linear
        self._frame = Frame(
            grid.inverse_depth,
            grid.distances_m,
            lattice(grid.shape, spacing),
            spacing,
            math.ceil(_MARGIN_PX * grid.unit_px / grid.step),
            smoothness,
            SQUARE_MOST * extended.inverse_depth_noise**2,
            config.large_error_m,
            extended.noise_floor * extended.inverse_depth_noise,
            floor_weights(config),
            grid.step,
            grid.image_shape[1],
            np.ascontiguousarray(rays.coefficients[:, :2, :2]),
            *rays.center,
            rays.scale,
        )
        self._store = Sets(
            np.empty((_SETS, 8), dtype=np.int64),
            np.empty((_RUNS, 3), dtype=np.int32),
            np.empty((_CELLS, 10, 10)),
            np.empty((_CELLS, 2, 4, 4)),
        )
        self._set_count = self._run_count = self._cell_count = 0
        self._members: dict[Fit, list[int]] = {}

    def of_labels(self, labels: NDArray[np.int32], number_of: NDArray[np.int64]) -> list[Fitted]:
        """Fit a surface to the grid pixels of each number, 1, 2, ...

        Labels are (h, w); the number of each, 0 for none, is that of a table. Label 0 belongs to none.
        """
        table, first, runs, used = self._begin(int(number_of.max()), labels.size)
        self._run_count = runs_of_labels(labels, number_of, table, first, runs, used)
        return self._fitted_sets(first)

    def of_pixels(self, parts: Sequence[NDArray[np.intp]]) -> list[Fitted]:
        """Fit a surface to each of some arrays of flat grid pixels, (N,) intp, ascending."""
        bounds, pixels = np.array([0, *accumulate(part.size for part in parts)]), np.concatenate(parts)
        table, first, runs, used = self._begin(len(parts), pixels.size)
        self._run_count = runs_of_pixels(pixels, bounds, self.grid.shape[1], table, first, runs, used)
        return self._fitted_sets(first)

    def of_union(self, fits: Iterable[Fit]) -> Fitted:
        """Fit one surface to the points of several fits of this fitter, which share none."""
        members = [member for fit in fits for member in self._members[fit]]
        numbers = np.array(members)
        # The members are among the sets that there are.
        table, first, runs, used = self._begin(1, self._run_count)
        self._run_count = runs_of_union(numbers, self.grid.shape[0], table, first, runs, used)
        _, *sizes = lay_out(self._store, first, first + 1, self._frame, self._cell_count)
        return self._fitted(first, numbers, [members], *sizes)[0]

    def _begin(self, sets: int, runs: int) -> tuple[NDArray[np.int64], int, NDArray[np.int32], int]:
        """Make room for more sets and runs at most; return the tables, with their numbers of rows."""
        first, used = self._set_count, self._run_count
        self._set_count += sets
        table, rows = _with_room(self._store.table, first, sets), _with_room(self._store.runs, used, runs)
        self._store = Sets(table, rows, *self._store[2:])
        return table, first, rows, used

    def _fitted_sets(self, first: int) -> list[Fitted]:
        """Sum over the cells of the last sets, and fit them."""
        end, used = self._set_count, self._cell_count
        self._cell_count, *sizes = lay_out(self._store, first, end, self._frame, used)
        sums = (_with_room(table, used, self._cell_count - used) for table in self._store[2:])
        self._store = Sets(*self._store[:2], *sums)
        sum_cells(self._store, first, end, self._frame)
        return self._fitted(first, np.arange(first, end), [[number] for number in range(first, end)], *sizes)

    def _fitted(
        self, first: int, numbers: NDArray[np.int64], members: list[list[int]], points: int, values_most: int
    ) -> list[Fitted]:
        """Fit surfaces to the last sets, of which each is the union of some; numbers are those of all."""
        grid, config, count = self.grid, self._config, len(members)
        bounds = np.array([0, *accumulate(map(len, members))])
        splines, measures = np.empty((count, SPLINE), dtype=np.int64), np.empty((count, MEASURES))
        values, residuals_m = np.empty(values_most), np.empty(points)
        pixels, in_image = np.empty(points, dtype=np.intp), np.empty(points, dtype=np.intp)
        found = splines, measures, values, (pixels, in_image), residuals_m
        fit_splines(self._store, first, numbers, bounds, self._frame, *found)
        if not self._is_linear:
            _place_on_rays(splines, values, grid.rays)
        for array in (values, residuals_m, in_image):
            array.setflags(write=False)
        fitted, end = [], 0
        for own, spline, of in zip(measures.tolist(), splines.tolist(), members, strict=True):
            at, nv, nu, outcome, size, *window = spline
            begin, end = end, end + size
            if outcome == UNSOLVED:
                reason = "no least-squares solution: the normal equations have no finite solution"
                reason = reason if size else "0 points, 1 needed"
                fit = Fit(None, np.zeros(0), {}, reason, in_image[begin:end])
            else:
                weights, points_m, *both = _parts(values, at, nv, nu)
                surface = unchecked(NurbsSurface, _DEGREE, *both, points_m, weights, tuple(window))
                metrics = MappingProxyType(dict(zip(RESIDUAL_METRICS, own, strict=False)))
                own_pixels = residuals_m[begin:end], metrics, "", in_image[begin:end]
                fit = unchecked(Fit, surface, *own_pixels, own[FLOOR], own[RMS])
                if config.metric in CURVATURE_METRICS:
                    from nurbseg.segmentation.surfaces.curvature import all_metrics

                    metrics = MappingProxyType(all_metrics(fit, grid.image_shape[1], config))
                    fit = replace(fit, values=metrics, floor=curvature_floor(size, grid, config))
            self._members[fit] = of
            fitted.append((pixels[begin:end], fit))
        return fitted


def _with_room(table: NDArray[Any], used: int, more: int) -> NDArray[Any]:
    """Return a table with room for more rows, itself if it has; rows that are not used yet are lost."""
    if used + more <= len(table):
        return table
    larger = np.empty((max(2 * len(table), used + more), *table.shape[1:]), dtype=table.dtype)
    larger[:used] = table[:used]
    return larger


def _parts(values: NDArray[np.float64], at: int, nv: int, nu: int) -> tuple[NDArray[np.float64], ...]:
    """Return control values, control points, and knots along u and v, of the spline at a value."""
    net, u, v = at + nv * nu, at + 4 * nv * nu, at + 4 * nv * nu + nu + 4
    weights, points_m = values[at:net].reshape(nv, nu), values[net:u].reshape(nv, nu, 3)
    return weights, points_m, values[u:v], values[v : v + nv + 4]


def _place_on_rays(splines: NDArray[np.int64], values: NDArray[np.float64], rays: Rays) -> None:
    """Fill in the control points of splines, meters, for rays that are not linear."""
    for at, nv, nu, outcome, *_ in splines.tolist():
        if outcome != UNSOLVED:
            weights, points_m, knots_u, knots_v = _parts(values, at, nv, nu)
            points_m[..., :2] = np.moveaxis(ray_control_values(rays, knots_u, knots_v) / weights, 0, -1)


def ray_control_values(
    rays: Rays, knots_u: NDArray[np.float64], knots_v: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the control values of cubic splines that interpolate the rays.

    Parameters
    ----------
    rays : Rays
        Of the camera.
    knots_u, knots_v : (m + 4,), (n + 4,) float64
        Knot vectors, pixels.

    Returns
    -------
    (2, n, m) float64
        Of x / z and y / z. The splines agree with the rays at the Greville abscissae, the means of three
        successive knots: exactly if the rays are linear, else to the fourth order in the knot spacing.

    References
    ----------
    .. [1] C. de Boor, "A Practical Guide to Splines", 1978, chapter 13.
    """
    u, take_u = _interpolator(knots_u)
    v, take_v = _interpolator(knots_v)
    return np.stack([take_v @ each @ take_u.T for each in rays.at(u, v[:, np.newaxis])])


def _interpolator(knots: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Greville abscissae of a knot vector, and the matrix from values there to control values."""
    abscissae = np.asarray(knots[1:-3] + knots[2:-2] + knots[3:-1], dtype=np.float64) / 3.0
    return abscissae, np.asarray(np.linalg.inv(basis_matrices(knots, CUBIC, abscissae)[0]), dtype=np.float64)
