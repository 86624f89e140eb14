"""Many surfaces evaluated at once, each on its own lattice: what drawing a frame's surfaces needs.

A call for each of fifty small surfaces costs more than the arithmetic does; here all surfaces lie end to end
in a few arrays, and one compiled loop goes through them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F32, F64, Bool, Intp, compiled, inlined
from nurbseg.segmentation.surfaces.bspline import CUBIC, cubic_functions, knot_span
from nurbseg.segmentation.surfaces.surface import NurbsSurface


@dataclass(frozen=True, slots=True, eq=False)
class Lattices:
    """Evenly spaced rows and columns over the windows of surfaces.

    Parameters
    ----------
    first : (L, 2) float64
        First row and column of each surface's lattice, pixels.
    step : (L, 2) float64
        Distance of its rows and of its columns, pixels.
    count : (L, 2) intp
        Number of its rows and of its columns.
    start : (L,) intp
        Where its vertices begin among those of all; they count row by row.
    """

    first: NDArray[np.float64]
    step: NDArray[np.float64]
    count: NDArray[np.intp]
    start: NDArray[np.intp]

    @classmethod
    def over(cls, surfaces: Sequence[NurbsSurface], step_px: float) -> Self:
        """Lay a lattice over each surface's window, its border included, with steps near `step_px` pixels."""
        windows = np.array([surface.window for surface in surfaces], dtype=np.float64).reshape(-1, 4)
        first = np.ascontiguousarray(windows[:, :2])
        extent = np.maximum(windows[:, 2:] - 1.0 - first, 0.0)
        count = np.maximum(np.rint(extent / step_px).astype(np.intp) + 1, 2)
        sizes = count[:, 0] * count[:, 1]
        return cls(first, extent / (count - 1), count, np.cumsum(sizes) - sizes)

    @property
    def vertices(self) -> int:
        """Number of the vertices of all lattices."""
        return int((self.count[:, 0] * self.count[:, 1]).sum())


def evaluate_vertices(
    surfaces: Sequence[NurbsSurface], lattices: Lattices, wanted: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Evaluate bicubic surfaces at vertices of their lattices.

    Parameters
    ----------
    surfaces : sequence of NurbsSurface
        Bicubic.
    lattices : Lattices
        Of these surfaces.
    wanted : (V,) bool
        Which of the lattices' vertices.

    Returns
    -------
    (N, 3) float32
        Points, metres, of the wanted vertices in their order.

    Raises
    ------
    ValueError
        If a surface is not bicubic.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, algorithms A2.2 and A4.3.
    """
    for surface in surfaces:
        if surface.degree != (CUBIC, CUBIC):
            raise ValueError(f"surfaces: expected bicubic ones, got degree {surface.degree}")
    points = np.empty((np.count_nonzero(wanted), 3), dtype=np.float32)
    if surfaces:
        _evaluate(
            np.concatenate([each.knots_u for each in surfaces]),
            np.concatenate([each.knots_v for each in surfaces]),
            np.concatenate([each.control_points_m.reshape(-1, 3) for each in surfaces]),
            np.concatenate([each.weights.ravel() for each in surfaces]),
            np.array([each.weights.shape for each in surfaces], dtype=np.intp),
            lattices.first,
            lattices.step,
            lattices.count,
            wanted,
            points,
        )
    return points


@compiled
def _evaluate(
    knots_u: F64,
    knots_v: F64,
    control: F64,
    weights: F64,
    shapes: Intp,
    first: F64,
    step: F64,
    count: Intp,
    wanted: Bool,
    points: F32,
) -> None:
    """Fill `points`: for each lattice row a curve of homogeneous points, evaluated at the columns."""
    basis_v = np.empty(CUBIC + 1)
    at_u = at_v = net = vertex = done = 0
    for surface in range(shapes.shape[0]):
        height, width = shapes[surface]
        curve = np.empty((width, 4))
        bases_u = np.empty((count[surface, 1], CUBIC + 1))
        spans_u = np.empty(count[surface, 1], dtype=np.intp)
        own_u = knots_u[at_u : at_u + width + CUBIC + 1]
        own_v = knots_v[at_v : at_v + height + CUBIC + 1]
        for column in range(count[surface, 1]):
            u = first[surface, 1] + column * step[surface, 1]
            spans_u[column] = _basis(own_u, u, bases_u[column])
        for row in range(count[surface, 0]):
            span_v = _basis(own_v, first[surface, 0] + row * step[surface, 0], basis_v)
            curve[:] = 0.0
            for a in range(CUBIC + 1):
                begin = net + (span_v + a) * width
                for b in range(width):
                    share = basis_v[a] * weights[begin + b]
                    for axis in range(3):
                        curve[b, axis] += share * control[begin + b, axis]
                    curve[b, 3] += share
            for column in range(count[surface, 1]):
                if wanted[vertex]:
                    x = y = z = w = 0.0
                    for b in range(CUBIC + 1):
                        at = curve[spans_u[column] + b]
                        x += bases_u[column, b] * at[0]
                        y += bases_u[column, b] * at[1]
                        z += bases_u[column, b] * at[2]
                        w += bases_u[column, b] * at[3]
                    points[done, 0], points[done, 1], points[done, 2] = x / w, y / w, z / w
                    done += 1
                vertex += 1
        at_u += width + CUBIC + 1
        at_v += height + CUBIC + 1
        net += height * width


@inlined
def _basis(knots: F64, at: float, values: F64) -> int:
    """Fill in the cubic functions that are not 0 at a parameter; return the number of the first."""
    span = knot_span(knots, at)
    values[0], values[1], values[2], values[3] = cubic_functions(knots, span, at)
    return span - CUBIC
