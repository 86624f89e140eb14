"""Inverse depths of many surfaces at scattered pixels."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I32, Intp, compiled, inlined
from nurbseg.segmentation.surfaces.bspline import CUBIC, Four, even_slopes, even_values
from nurbseg.segmentation.surfaces.surface import NurbsSurface

_ORDER = CUBIC + 1


class Splines(NamedTuple):
    """Splines of inverse depth by label, as compiled functions take them.

    Parameters
    ----------
    axes : (labels + 1, 2, 3) float64
        Along u and v the first of the even knots, one over their spacing, and the number of functions, 0
        where there is no surface.
    weights : (N,) float64
        Control values of all.
    starts : (labels + 1,) intp
        Where those of each begin.
    """

    axes: NDArray[np.float64]
    weights: NDArray[np.float64]
    starts: NDArray[np.intp]


class SurfaceTable:
    """Surfaces of inverse depth, to be evaluated at many pixels that belong to different ones.

    Parameters
    ----------
    surfaces : sequence of NurbsSurface or None
        Of the labels 1, 2, ..., as fitted to inverse depth: cubic on evenly spaced knots, with weights that
        are proportional to inverse depth. A label without a surface has no inverse depth anywhere.

    Attributes
    ----------
    splines : Splines
        Their control values and knots, as compiled functions take them.
    """

    def __init__(self, surfaces: Sequence[NurbsSurface | None]) -> None:
        labels = [label for label, surface in enumerate(surfaces, start=1) if surface is not None]
        known = [surface for surface in surfaces if surface is not None]
        knots = [(k[0], k[1], k.size) for each in known for k in (each.knots_u, each.knots_v)]
        first, second, count = np.array(knots, dtype=np.float64).reshape(-1, 2, 3).transpose(2, 0, 1)
        axes, sizes = np.zeros((len(surfaces) + 1, 2, 3)), np.zeros(len(surfaces) + 1, dtype=np.intp)
        axes[labels] = np.stack([first, 1.0 / (second - first), count - _ORDER], axis=-1)
        sizes[labels] = [each.weights.size for each in known]
        units = [each.control_points_m[0, 0, 2] * each.weights[0, 0] for each in known]
        nets = np.concatenate([np.zeros(0), *(each.weights.ravel() for each in known)])
        starts = np.cumsum(sizes) - sizes
        self.splines = Splines(axes, nets / np.repeat(units, sizes[labels]), starts)

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
        return _evaluate(self.splines, labels, rows, columns)

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
        found = _evaluate_slopes(self.splines, labels, u, v)
        return found[0], found[1], found[2]


@inlined
def _functions(axes: F64, label: int, axis: int, t: float) -> tuple[int, Four, Four]:
    """Evaluate the basis functions that are not 0 at t: number of the first, values and derivatives."""
    per_spacing = axes[label, axis, 1]
    position = (t - axes[label, axis, 0]) * per_spacing
    span = min(max(int(position), CUBIC), int(axes[label, axis, 2]) - 1)
    return span - CUBIC, even_values(position - span), even_slopes(position - span, per_spacing)


@inlined
def dot(B: Four, values: F64, first: int, step: int) -> float:
    """Sum four values that are a step apart, weighted by a basis."""
    return float(
        (B[0] * values[first] + B[1] * values[first + step])
        + (B[2] * values[first + 2 * step] + B[3] * values[first + 3 * step])
    )


@inlined
def spline_at(axes: F64, weights: F64, starts: Intp, label: int, row: int, column: int) -> float:
    """Evaluate a label's surface at a pixel.

    Steps inside of a loop have no branch: references to arrays would be counted at each.
    """
    length = int(axes[label, 0, 2])
    across, Bv, _ = _functions(axes, label, 1, float(row))
    along, Bu, _ = _functions(axes, label, 0, float(column))
    first, value = starts[label] + across * length + along, 0.0
    for k in range(_ORDER):
        value += Bu[k] * dot(Bv, weights, first + k, length)
    return value


@compiled
def _evaluate(splines: Splines, labels: I32, rows: I32, columns: I32) -> F32:
    axes, weights, starts = splines
    inverse_depth = np.full(labels.size, np.nan, dtype=np.float32)
    for n in range(labels.size):
        if axes[labels[n], 0, 2] > 0.0:
            inverse_depth[n] = spline_at(axes, weights, starts, labels[n], rows[n], columns[n])
    return inverse_depth


@compiled
def _evaluate_slopes(splines: Splines, labels: I32, columns: F64, rows: F64) -> F64:
    axes, weights, starts = splines
    found = np.empty((3, labels.size))
    for n in range(labels.size):
        label = labels[n]
        length = int(axes[label, 0, 2])
        if length == 0:
            found[:, n] = np.nan
            continue
        column, Bu, Du = _functions(axes, label, 0, columns[n])
        row, Bv, Dv = _functions(axes, label, 1, rows[n])
        first = starts[label] + row * length + column
        value, along_u, along_v = 0.0, 0.0, 0.0
        for k in range(_ORDER):
            across = dot(Bv, weights, first + k, length)
            value += Bu[k] * across
            along_u += Du[k] * across
            along_v += Bu[k] * dot(Dv, weights, first + k, length)
        found[0, n], found[1, n], found[2, n] = value, along_u, along_v
    return found
