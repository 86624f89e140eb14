"""Many surfaces at scattered pixels: the inverse depth of another surface at each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled, inlined
from nurbseg.segmentation.surfaces.bspline import (
    CUBIC,
    Four,
    cubic_functions,
    even_slopes,
    even_values,
    knot_span,
)
from nurbseg.segmentation.surfaces.surface import NurbsSurface

_ORDER = CUBIC + 1
#: Knots count as evenly spaced up to this share of a space.
_EVEN = 1e-9


class _Axis(NamedTuple):
    """Knot vectors of all surfaces along one axis: where each begins, and one over the space of even ones."""

    knots: NDArray[np.float64]
    starts: NDArray[np.intp]
    counts: NDArray[np.intp]
    per_spacing: NDArray[np.float64]


class _Nets(NamedTuple):
    """Weights of all surfaces and their products with the control points' depths, and where each begins.

    Where these products are all the same, as for surfaces of inverse depth, the weights are divided by them
    and the surface is plain: its inverse depth is the spline of the weights.
    """

    weights: NDArray[np.float64]
    depths: NDArray[np.float64]
    starts: NDArray[np.intp]
    plain: NDArray[np.bool_]


class SurfaceTable:
    """Bicubic surfaces, to be evaluated at many places that belong to different ones.

    Parameters
    ----------
    surfaces : sequence of NurbsSurface or None
        Of the labels 1, 2, ...; a label without one has no inverse depth.

    Raises
    ------
    ValueError
        If a surface is not bicubic.
    """

    def __init__(self, surfaces: Sequence[NurbsSurface | None]) -> None:
        for surface in surfaces:
            if surface is not None and surface.degree != (CUBIC, CUBIC):
                raise ValueError(f"surfaces: expected bicubic ones, got degree {surface.degree}")
        self._u = _axis([None if each is None else each.knots_u for each in surfaces])
        self._v = _axis([None if each is None else each.knots_v for each in surfaces])
        known = [each for each in surfaces if each is not None]
        weights = np.concatenate([each.weights.ravel() for each in known] or [np.zeros(0)])
        depths = np.concatenate([each.control_points_m[..., 2].ravel() for each in known] or [np.zeros(0)])
        depths *= weights
        starts = np.concatenate([[0], np.cumsum(self._u.counts * self._v.counts)])
        self._nets = _Nets(weights, depths, starts, np.zeros(starts.size - 1, dtype=np.bool_))
        _divide(self._nets)

    def inverse_depths(
        self, labels: NDArray[np.int32], rows: NDArray[np.int32], columns: NDArray[np.int32]
    ) -> NDArray[np.float32]:
        """Return the inverse depth of each label's surface at a pixel.

        Parameters
        ----------
        labels, rows, columns : (N,) int32
            Which surface, and where. Beyond its knots the polynomials of the ends go on.

        Returns
        -------
        (N,) float32
            In 1/m; NaN where a label has no surface.
        """
        per_m = np.empty(labels.size, dtype=np.float32)
        _evaluate(self._u, self._v, self._nets, labels, rows, columns, per_m)
        return per_m

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
        per_m, slope_u, slope_v : (N,) float64
            Inverse depth in 1/m and its change by one pixel along u and v; NaN where a label has no surface.
        """
        found = np.empty((3, labels.size))
        _evaluate_slopes(self._u, self._v, self._nets, labels, u, v, found)
        return found[0], found[1], found[2]


def _axis(knots: Sequence[NDArray[np.float64] | None]) -> _Axis:
    """Put knot vectors one after the other, (0,) for none; number 0 has none either."""
    counts = np.array([0, *(0 if each is None else each.size - _ORDER for each in knots)], dtype=np.intp)
    starts = np.concatenate([[0], np.cumsum(np.where(counts > 0, counts + _ORDER, 0))])
    flat = np.concatenate([each for each in knots if each is not None] or [np.zeros(0)])
    axis = _Axis(flat, starts, counts, np.zeros(counts.size))
    _find_even(axis)
    return axis


@compiled
def _find_even(axis: _Axis) -> None:
    """Say how far even knots are apart; uneven ones keep 0."""
    for label in range(axis.counts.size):
        if axis.counts[label] == 0:
            continue
        first, last = axis.starts[label], axis.starts[label + 1] - 1
        spacing = axis.knots[first + 1] - axis.knots[first]
        even = spacing > 0
        for n in range(first + 1, last):
            even &= abs(axis.knots[n + 1] - axis.knots[n] - spacing) <= _EVEN * spacing
        if even:
            axis.per_spacing[label] = 1.0 / spacing


@compiled
def _divide(nets: _Nets) -> None:
    """Find the plain surfaces, and divide their weights."""
    for label in range(nets.plain.size):
        first, end = nets.starts[label], nets.starts[label + 1]
        nets.plain[label] = True
        for n in range(first, end):
            nets.plain[label] &= abs(nets.depths[n] - nets.depths[first]) <= 1e-12
        if nets.plain[label]:
            for n in range(first, end):
                nets.weights[n] /= nets.depths[first]


@inlined
def _functions(axis: _Axis, label: int, t: float) -> tuple[int, Four, Four]:
    """Evaluate the basis functions that are not 0 at t: number of the first, values and derivatives."""
    start, count = axis.starts[label], axis.counts[label]
    per_spacing = axis.per_spacing[label]
    if per_spacing == 0:
        span = knot_span(axis.knots, start, count, t)
        values, derivatives = cubic_functions(axis.knots, start + span, t)
        return span - CUBIC, values, derivatives
    # The same four polynomials on every span.
    place = (t - axis.knots[start]) * per_spacing
    span = min(max(int(place), CUBIC), count - 1)
    return span - CUBIC, even_values(place - span), even_slopes(place - span, per_spacing)


@inlined
def _dot(B: Four, values: NDArray[np.float64], first: int, step: int) -> float:
    """Add up four values that are a step apart, weighted by a basis."""
    return float(
        (B[0] * values[first] + B[1] * values[first + step])
        + (B[2] * values[first + 2 * step] + B[3] * values[first + 3 * step])
    )


@compiled
def _evaluate(
    u: _Axis,
    v: _Axis,
    nets: _Nets,
    labels: NDArray[np.int32],
    rows: NDArray[np.int32],
    columns: NDArray[np.int32],
    per_m: NDArray[np.float32],
) -> None:
    # Places come row by row: a surface along its last row is kept, a curve over the columns.
    last_row = np.full(u.counts.size, np.iinfo(np.int32).min, dtype=np.int32)
    longest = 0
    for count in u.counts:
        longest = max(longest, count)
    weights = np.empty((u.counts.size, longest))
    depths = np.empty_like(weights)
    for n in range(labels.size):
        label = labels[n]
        length = u.counts[label]
        if length == 0:
            per_m[n] = np.nan
            continue
        if last_row[label] != rows[n]:
            last_row[label] = rows[n]
            row, Bv, _ = _functions(v, label, float(rows[n]))
            first = nets.starts[label] + row * length
            for k in range(length):
                weights[label, k] = _dot(Bv, nets.weights, first + k, length)
                if not nets.plain[label]:
                    depths[label, k] = _dot(Bv, nets.depths, first + k, length)
        column, Bu, _ = _functions(u, label, float(columns[n]))
        found = _dot(Bu, weights[label], column, 1)
        if not nets.plain[label]:
            found /= _dot(Bu, depths[label], column, 1)
        per_m[n] = found


@inlined
def _sums(
    net: NDArray[np.float64], first: int, length: int, Bu: Four, Du: Four, Bv: Four, Dv: Four
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
def _evaluate_slopes(
    u: _Axis,
    v: _Axis,
    nets: _Nets,
    labels: NDArray[np.int32],
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    found: NDArray[np.float64],
) -> None:
    for n in range(labels.size):
        label = labels[n]
        length = u.counts[label]
        if length == 0:
            found[:, n] = np.nan
            continue
        column, Bu, Du = _functions(u, label, columns[n])
        row, Bv, Dv = _functions(v, label, rows[n])
        first = nets.starts[label] + row * length + column
        per_m, along_u, along_v = _sums(nets.weights, first, length, Bu, Du, Bv, Dv)
        if not nets.plain[label]:
            depth, depth_u, depth_v = _sums(nets.depths, first, length, Bu, Du, Bv, Dv)
            per_m /= depth
            along_u, along_v = (along_u - per_m * depth_u) / depth, (along_v - per_m * depth_v) / depth
        found[0, n], found[1, n], found[2, n] = per_m, along_u, along_v


__all__ = ["SurfaceTable"]
