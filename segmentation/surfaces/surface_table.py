"""Inverse depths of many surfaces at scattered pixels."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F32, F64, I32, compiled, inlined
from nurbseg.segmentation.surfaces.bspline import CUBIC, Four, even_slopes, even_values
from nurbseg.segmentation.surfaces.surface import NurbsSurface

_ORDER = CUBIC + 1
#: Relative rounding of the knot spacing, and of weights times depths.
_ROUNDING = 1e-9


class _Axis(NamedTuple):
    """Even knots of all surfaces along one axis: the first, one over the spacing, the number of functions."""

    first: NDArray[np.float64]
    per_spacing: NDArray[np.float64]
    counts: NDArray[np.intp]


class _Splines(NamedTuple):
    """Control values of all surfaces, each from its index in `starts` on, and their knots."""

    u: _Axis
    v: _Axis
    weights: NDArray[np.float64]
    starts: NDArray[np.intp]


class SurfaceTable:
    """Surfaces of inverse depth, to be evaluated at many pixels that belong to different ones.

    Parameters
    ----------
    surfaces : sequence of NurbsSurface or None
        Of the labels 1, 2, ..., as fitted to inverse depth; a label without one has no inverse depth.

    Raises
    ------
    ValueError
        If a surface is not bicubic on even knots, or its weights are not proportional to inverse depth.
    """

    def __init__(self, surfaces: Sequence[NurbsSurface | None]) -> None:
        nets = [np.zeros((0, 0)), *(np.zeros((0, 0)) if each is None else _net(each) for each in surfaces)]
        self._splines = _Splines(
            _axis([None, *(None if each is None else each.knots_u for each in surfaces)]),
            _axis([None, *(None if each is None else each.knots_v for each in surfaces)]),
            np.concatenate([net.ravel() for net in nets]),
            np.cumsum([0, *(net.size for net in nets[:-1])]),
        )

    def inverse_depths(
        self, labels: NDArray[np.int32], rows: NDArray[np.int32], columns: NDArray[np.int32]
    ) -> NDArray[np.float32]:
        """Return the inverse depth of each label's surface at a pixel.

        Parameters
        ----------
        labels, rows, columns : (N,) int32
            Which surface, and where. Beyond its knots it is extrapolated.

        Returns
        -------
        (N,) float32
            In 1/m; NaN where a label has no surface.
        """
        inverse_depth = np.empty(labels.size, dtype=np.float32)
        _evaluate(self._splines, labels, rows, columns, inverse_depth)
        return inverse_depth

    def slopes(
        self, labels: NDArray[np.int32], u: NDArray[np.float64], v: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the inverse depth of each label's surface between pixels, and its slopes.

        Parameters
        ----------
        labels : (N,) int32
            Which surface.
        u, v : (N,) float64
            Columns and rows, pixels.

        Returns
        -------
        inverse_depth, slope_u, slope_v : (N,) float64
            Inverse depth in 1/m and its change by one pixel along u and v; NaN where a label has no surface.
        """
        found = np.empty((3, labels.size))
        _evaluate_slopes(self._splines, labels, u, v, found)
        return found[0], found[1], found[2]


def _net(surface: NurbsSurface) -> NDArray[np.float64]:
    """Return the control values of a surface's inverse depth, 1/m."""
    if surface.degree != (CUBIC, CUBIC):
        raise ValueError(f"surfaces: expected bicubic ones, got degree {surface.degree}")
    even, depth = _checked(
        surface.knots_u, surface.knots_v, surface.control_points_m, np.ascontiguousarray(surface.weights)
    )
    if not even:
        raise ValueError("surfaces: expected even knots")
    if depth == 0.0:
        raise ValueError("surfaces: expected weights that are proportional to inverse depth")
    return np.asarray(surface.weights / depth)


@compiled
def _checked(knots_u: F64, knots_v: F64, points_m: F64, weights: F64) -> tuple[bool, float]:
    """Return whether knots are even, and depth times weight of the control points, 0 if these differ."""
    even = True
    for knots in (knots_u, knots_v):
        most = least = knots[1] - knots[0]
        for n in range(1, knots.size):
            most, least = max(most, knots[n] - knots[n - 1]), min(least, knots[n] - knots[n - 1])
        even &= least > 0 and most - least <= 2.0 * _ROUNDING * (knots[1] - knots[0])
    depth = points_m[0, 0, 2] * weights[0, 0]
    most = least = depth
    for row in range(weights.shape[0]):
        for column in range(weights.shape[1]):
            value = points_m[row, column, 2] * weights[row, column]
            most, least = max(most, value), min(least, value)
    return even, depth if most - least <= _ROUNDING * abs(depth) else 0.0


def _axis(knots: Sequence[NDArray[np.float64] | None]) -> _Axis:
    first = [0.0 if each is None else each[0] for each in knots]
    per_spacing = [0.0 if each is None else 1.0 / (each[1] - each[0]) for each in knots]
    counts = [0 if each is None else each.size - _ORDER for each in knots]
    return _Axis(np.array(first), np.array(per_spacing), np.array(counts, dtype=np.intp))


@inlined
def _functions(axis: _Axis, label: int, t: float) -> tuple[int, Four, Four]:
    """Evaluate the basis functions that are not 0 at t: number of the first, values and derivatives."""
    per_spacing = axis.per_spacing[label]
    position = (t - axis.first[label]) * per_spacing
    span = min(max(int(position), CUBIC), axis.counts[label] - 1)
    return span - CUBIC, even_values(position - span), even_slopes(position - span, per_spacing)


@inlined
def _dot(B: Four, values: F64, first: int, step: int) -> float:
    """Sum four values that are a step apart, weighted by a basis."""
    return float(
        (B[0] * values[first] + B[1] * values[first + step])
        + (B[2] * values[first + 2 * step] + B[3] * values[first + 3 * step])
    )


@compiled
def _evaluate(splines: _Splines, labels: I32, rows: I32, columns: I32, inverse_depth: F32) -> None:
    u, v, weights, starts = splines
    # Pixels come row by row: a surface along its last row is kept, a curve over the columns.
    last_row = np.full(u.counts.size, -(2**31), dtype=np.int32)
    longest = 0
    for count in u.counts:
        longest = max(longest, count)
    curves = np.empty((u.counts.size, longest))
    for n in range(labels.size):
        label = labels[n]
        length = u.counts[label]
        if length == 0:
            inverse_depth[n] = np.nan
            continue
        if last_row[label] != rows[n]:
            last_row[label] = rows[n]
            row, Bv, _ = _functions(v, label, float(rows[n]))
            first = starts[label] + row * length
            for k in range(length):
                curves[label, k] = _dot(Bv, weights, first + k, length)
        column, Bu, _ = _functions(u, label, float(columns[n]))
        inverse_depth[n] = _dot(Bu, curves[label], column, 1)


@inlined
def _sums(
    net: F64, first: int, length: int, Bu: Four, Du: Four, Bv: Four, Dv: Four
) -> tuple[float, float, float]:
    """Add up the sixteen control values at `first` and beside it: a spline and its slopes."""
    value, along_u, along_v = 0.0, 0.0, 0.0
    for k in range(_ORDER):
        across = _dot(Bv, net, first + k, length)
        value += Bu[k] * across
        along_u += Du[k] * across
        along_v += Bu[k] * _dot(Dv, net, first + k, length)
    return value, along_u, along_v


@compiled
def _evaluate_slopes(splines: _Splines, labels: I32, columns: F64, rows: F64, found: F64) -> None:
    u, v, weights, starts = splines
    for n in range(labels.size):
        label = labels[n]
        length = u.counts[label]
        if length == 0:
            found[:, n] = np.nan
            continue
        column, Bu, Du = _functions(u, label, columns[n])
        row, Bv, Dv = _functions(v, label, rows[n])
        first = starts[label] + row * length + column
        found[0, n], found[1, n], found[2, n] = _sums(weights, first, length, Bu, Du, Bv, Dv)
