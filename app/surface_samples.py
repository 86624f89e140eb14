"""Many surfaces evaluated at once, each on its own lattice: what drawing a frame's surfaces needs.

A call for each of fifty small surfaces costs more than the arithmetic does; here all positions of all
surfaces pass through each operation together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.surface import NurbsSurface


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
    def over(cls, surfaces: Sequence[NurbsSurface], step_px: float) -> Lattices:
        """Lay a lattice over each surface's window, its border included, with steps near `step_px` pixels."""
        windows = np.array([surface.window for surface in surfaces], dtype=np.float64).reshape(-1, 4)
        first = windows[:, :2]
        extent = np.maximum(windows[:, 2:] - 1.0 - first, 0.0)
        count = np.maximum(np.rint(extent / step_px).astype(np.intp) + 1, 2)
        sizes = count[:, 0] * count[:, 1]
        return cls(first, extent / (count - 1), count, np.cumsum(sizes) - sizes)

    def places(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Return surface, row and column of every vertex, (V,) each."""
        sizes = self.count[:, 0] * self.count[:, 1]
        surface = np.repeat(np.arange(len(sizes)), sizes)
        within = np.arange(int(sizes.sum())) - self.start[surface]
        row, column = np.divmod(within, self.count[surface, 1])
        return surface, row, column


def evaluate_vertices(
    surfaces: Sequence[NurbsSurface],
    lattices: Lattices,
    surface: NDArray[np.intp],
    row: NDArray[np.intp],
    column: NDArray[np.intp],
) -> NDArray[np.float32]:
    """Evaluate surfaces of one degree at vertices of their lattices.

    Parameters
    ----------
    surfaces : sequence of NurbsSurface
        All of the same degree.
    lattices : Lattices
        Of these surfaces.
    surface, row, column : (V,) intp
        Which vertices.

    Returns
    -------
    (V, 3) float32
        Points, metres.

    Raises
    ------
    ValueError
        If the degrees differ.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, algorithms A2.2 and A4.3.
    """
    degrees = {each.degree for each in surfaces}
    if len(degrees) > 1:
        raise ValueError(f"surfaces: expected one degree, got {sorted(degrees)}")
    if not surfaces:
        return np.zeros((0, 3), dtype=np.float32)
    degree_u, degree_v = degrees.pop()
    basis_v, span_v, start_v = _bases([each.knots_v for each in surfaces], degree_v, lattices, 0)
    basis_u, span_u, start_u = _bases([each.knots_u for each in surfaces], degree_u, lattices, 1)

    # The control points of all surfaces in one list, in homogeneous coordinates.
    net = np.concatenate(
        [
            np.concatenate(
                [each.control_points_m * each.weights[..., np.newaxis], each.weights[..., np.newaxis]],
                axis=-1,
            ).reshape(-1, 4)
            for each in surfaces
        ]
    ).astype(np.float32)
    width = np.array([each.weights.shape[1] for each in surfaces])
    net_start = np.array(list(accumulate((each.weights.size for each in surfaces), initial=0)))[:-1]

    at_v, at_u = start_v[surface] + row, start_u[surface] + column
    corner = net_start[surface] + span_v[at_v] * width[surface] + span_u[at_u]
    weight_v, weight_u = basis_v[at_v], basis_u[at_u]
    total = np.zeros((len(surface), 4), dtype=np.float32)
    for a in range(degree_v + 1):
        for b in range(degree_u + 1):
            share = weight_v[:, a] * weight_u[:, b]
            total += share[:, np.newaxis] * net[corner + b]
        corner = corner + width[surface]
    return total[:, :3] / total[:, 3:]


def _bases(
    knots: Sequence[NDArray[np.float64]], degree: int, lattices: Lattices, axis: int
) -> tuple[NDArray[np.float32], NDArray[np.intp], NDArray[np.intp]]:
    """Evaluate the basis functions that are not 0 at each row (axis 0) or column (axis 1) of all lattices.

    Returns
    -------
    values : (M, degree + 1) float32
        Of the functions.
    first : (M,) intp
        Index of the first of them.
    start : (L,) intp
        Where the rows or columns of each surface begin.
    """
    count = lattices.count[:, axis]
    start = np.cumsum(count) - count
    surface = np.repeat(np.arange(len(count)), count)
    within = np.arange(int(count.sum())) - start[surface]
    at = lattices.first[surface, axis] + within * lattices.step[surface, axis]

    first = np.empty(at.size, dtype=np.intp)
    for each, begin, size in zip(knots, start, count, strict=True):
        inner = each[degree + 1 : each.size - degree - 1]
        first[begin : begin + size] = np.searchsorted(inner, at[begin : begin + size], side="right")
    knots_start = np.cumsum([0, *(each.size for each in knots[:-1])])
    span = knots_start[surface] + first + degree
    all_knots = np.concatenate(knots)

    values = np.zeros((at.size, degree + 1))
    values[:, 0] = 1.0
    for order in range(1, degree + 1):
        saved = np.zeros(at.size)
        for r in range(order):
            right, left = all_knots[span + r + 1], all_knots[span + r + 1 - order]
            # Knots that coincide enclose nothing: their function is 0.
            share = np.divide(values[:, r], right - left, out=np.zeros(at.size), where=right > left)
            values[:, r] = saved + (right - at) * share
            saved = (at - left) * share
        values[:, order] = saved
    return values.astype(np.float32), first, start


__all__ = ["Lattices", "evaluate_vertices"]
