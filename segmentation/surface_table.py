"""Many surfaces at scattered pixels: the inverse depth of another surface at each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.bspline import CUBIC
from nurbseg.segmentation.compiled import compiled
from nurbseg.segmentation.surface import NurbsSurface

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


@compiled
def _functions(axis: _Axis, label: int, t: float, values: NDArray[np.float64]) -> int:
    """Evaluate the four basis functions that are not 0 at t; return the number of the first."""
    start, count = axis.starts[label], axis.counts[label]
    per_spacing = axis.per_spacing[label]
    if per_spacing > 0:
        # The same four polynomials on every span.
        place = (t - axis.knots[start]) * per_spacing
        span = min(max(int(np.floor(place)), CUBIC), count - 1)
        s = place - span
        r = 1.0 - s
        values[0] = r * r * r * (1.0 / 6.0)
        values[1] = 2.0 / 3.0 - s * s * (1.0 - 0.5 * s)
        values[2] = 2.0 / 3.0 - r * r * (1.0 - 0.5 * r)
        values[3] = s * s * s * (1.0 / 6.0)
        return int(span) - CUBIC
    span = _span(axis, label, t)
    _cox_de_boor(axis.knots, start + span, CUBIC, t, values)
    return span - CUBIC


@compiled
def _derivatives(axis: _Axis, label: int, t: float, values: NDArray[np.float64]) -> None:
    """Evaluate the derivatives of the same four functions."""
    start, count = axis.starts[label], axis.counts[label]
    per_spacing = axis.per_spacing[label]
    if per_spacing > 0:
        place = (t - axis.knots[start]) * per_spacing
        s = place - min(max(int(np.floor(place)), CUBIC), count - 1)
        r = 1.0 - s
        values[0] = -0.5 * r * r * per_spacing
        values[1] = s * (1.5 * s - 2.0) * per_spacing
        values[2] = -r * (1.5 * r - 2.0) * per_spacing
        values[3] = 0.5 * s * s * per_spacing
        return
    span = start + _span(axis, label, t)
    _cox_de_boor(axis.knots, span, CUBIC - 1, t, values)
    # Those of degree 2 over the widths of their supports.
    before = 0.0
    for n in range(CUBIC):
        width = axis.knots[span + n + 1] - axis.knots[span + n + 1 - CUBIC]
        ratio = CUBIC * values[n] / width
        values[n] = before - ratio
        before = ratio
    values[CUBIC] = before


@compiled
def _span(axis: _Axis, label: int, t: float) -> int:
    """Return the knot span that holds t; the end spans also hold what lies beyond them."""
    start, count = axis.starts[label], axis.counts[label]
    end = axis.knots[start + count]
    span = CUBIC
    while span < count - 1 and axis.knots[start + span + 1] <= t and axis.knots[start + span + 1] < end:
        span += 1
    return span


@compiled
def _cox_de_boor(
    knots: NDArray[np.float64], span: int, degree: int, t: float, values: NDArray[np.float64]
) -> None:
    """Evaluate the basis functions of a degree on a span that is not empty (The NURBS Book, A2.2)."""
    values[0] = 1.0
    for p in range(1, degree + 1):
        saved = 0.0
        for n in range(p):
            after, before = knots[span + n + 1] - t, t - knots[span + 1 + n - p]
            ratio = values[n] / (after + before)
            values[n] = saved + after * ratio
            saved = before * ratio
        values[p] = saved


@compiled
def _sum(
    net: NDArray[np.float64], first: int, row_length: int, Bv: NDArray[np.float64], Bu: NDArray[np.float64]
) -> float:
    """Add up the sixteen control values at `first` and beside it, weighted by both bases."""
    total = 0.0
    for a in range(_ORDER):
        at = first + a * row_length
        along = net[at] * Bu[0] + net[at + 1] * Bu[1] + net[at + 2] * Bu[2] + net[at + 3] * Bu[3]
        total += Bv[a] * along
    return total


@compiled
def _line(
    net: NDArray[np.float64], first: int, length: int, Bv: NDArray[np.float64], line: NDArray[np.float64]
) -> None:
    """Add up four rows of control values from `first` on, weighted by a basis."""
    for n in range(length):
        at = first + n
        line[n] = (Bv[0] * net[at] + Bv[1] * net[at + length]) + (
            Bv[2] * net[at + 2 * length] + Bv[3] * net[at + 3 * length]
        )


@compiled
def _dot(Bu: NDArray[np.float64], line: NDArray[np.float64], first: int) -> float:
    return float(
        (Bu[0] * line[first] + Bu[1] * line[first + 1]) + (Bu[2] * line[first + 2] + Bu[3] * line[first + 3])
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
    Bu, Bv = np.empty(_ORDER), np.empty(_ORDER)
    # Places come row by row: a surface along the last row is kept, a curve over the columns.
    last_row = np.full(u.counts.size, np.iinfo(np.int32).min, dtype=np.int32)
    weights = np.empty((u.counts.size, u.counts.max()))
    depths = np.empty_like(weights)
    for n in range(labels.size):
        label = labels[n]
        length = u.counts[label]
        if length == 0:
            per_m[n] = np.nan
            continue
        if last_row[label] != rows[n]:
            last_row[label] = rows[n]
            first = nets.starts[label] + _functions(v, label, rows[n], Bv) * length
            _line(nets.weights, first, length, Bv, weights[label])
            if not nets.plain[label]:
                _line(nets.depths, first, length, Bv, depths[label])
        column = _functions(u, label, columns[n], Bu)
        found = _dot(Bu, weights[label], column)
        if not nets.plain[label]:
            found /= _dot(Bu, depths[label], column)
        per_m[n] = found


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
    Bu, Bv, Du, Dv = np.empty(_ORDER), np.empty(_ORDER), np.empty(_ORDER), np.empty(_ORDER)
    for n in range(labels.size):
        label = labels[n]
        length = u.counts[label]
        if length == 0:
            found[:, n] = np.nan
            continue
        column, row = _functions(u, label, columns[n], Bu), _functions(v, label, rows[n], Bv)
        _derivatives(u, label, columns[n], Du)
        _derivatives(v, label, rows[n], Dv)
        first = nets.starts[label] + row * length + column
        per_m = _sum(nets.weights, first, length, Bv, Bu)
        along_u = _sum(nets.weights, first, length, Bv, Du)
        along_v = _sum(nets.weights, first, length, Dv, Bu)
        if not nets.plain[label]:
            depth = _sum(nets.depths, first, length, Bv, Bu)
            per_m /= depth
            along_u = (along_u - per_m * _sum(nets.depths, first, length, Bv, Du)) / depth
            along_v = (along_v - per_m * _sum(nets.depths, first, length, Dv, Bu)) / depth
        found[0, n], found[1, n], found[2, n] = per_m, along_u, along_v


__all__ = ["SurfaceTable"]
