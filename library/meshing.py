"""The fitted surfaces of a frame as one triangle mesh, trimmed to the pixels of their segments.

All surfaces lie end to end in a few arrays: fifty calls for small ones would cost more than the arithmetic.
"""

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I64, U16, Bool, Intp, compiled, inlined
from nurbseg.library.surface_mesh import SurfaceMesh
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.surfaces.bspline import CUBIC, cubic_functions, knot_span
from nurbseg.segmentation.surfaces.surface import NurbsSurface

#: Every so many rows and columns of a lattice are drawn as lines.
_ISOLINE_EVERY = 4


def surface_mesh(tree: SegmentationTree, labels: NDArray[np.uint16], step_px: float) -> SurfaceMesh:
    """Sample the surface of every leaf on a lattice and keep the triangles that lie on its segment.

    Parameters
    ----------
    tree : SegmentationTree
        The segments; leaves without a surface are left out.
    labels : (H, W) uint16
        The tree's label image.
    step_px : float
        Distance of the lattice's rows and columns, pixels.

    Returns
    -------
    SurfaceMesh
        Empty where no leaf has a surface.
    """
    fits = {label: leaf.fit for label, leaf in enumerate(tree.leaves(), 1) if leaf.fit.surface is not None}
    surfaces = [fit.surface for fit in fits.values() if fit.surface is not None]
    label_of = np.array([*fits], dtype=np.uint16)
    lattices = Lattices.over(surfaces, step_px)
    row_of = np.empty(lattices.vertices, dtype=np.int64)
    corners = np.empty((2 * lattices.vertices, 3), dtype=np.uint32)
    cut = _trimmed_triangles(np.ascontiguousarray(labels), label_of, lattices, row_of, corners)
    triangles = corners[:cut].copy()
    wanted = row_of >= 0
    vertices = evaluate_vertices(surfaces, lattices, wanted)
    normals = np.zeros_like(vertices)
    _normals(vertices, triangles, normals)
    residuals = np.zeros(len(vertices), dtype=np.float32)
    if fits:
        _mean_residuals(
            np.concatenate([fit.pixels for fit in fits.values()]),
            np.concatenate([fit.residuals_m for fit in fits.values()]),
            np.array([fit.pixels.size for fit in fits.values()], dtype=np.intp),
            labels.shape[1],
            lattices,
            row_of,
            residuals,
        )
    labels_of_vertices = np.repeat(label_of, lattices.counts.prod(axis=1))[wanted]
    lines = isolines(lattices, row_of, _ISOLINE_EVERY)
    return SurfaceMesh(vertices, normals, triangles, residuals, labels_of_vertices, *lines)


class Lattices(NamedTuple):
    """Evenly spaced rows and columns over the windows of surfaces.

    Parameters
    ----------
    first : (L, 2) float64
        First row and column of each surface's lattice, pixels.
    step : (L, 2) float64
        Distance of its rows and of its columns, pixels.
    counts : (L, 2) intp
        Number of its rows and of its columns.
    start : (L,) intp
        Where its vertices begin among those of all; they count row by row.
    """

    first: NDArray[np.float64]
    step: NDArray[np.float64]
    counts: NDArray[np.intp]
    start: NDArray[np.intp]

    @classmethod
    def over(cls, surfaces: Sequence[NurbsSurface], step_px: float) -> Self:
        """Lay a lattice over each surface's window, its border included, with steps near `step_px` pixels."""
        windows = np.array([surface.window for surface in surfaces], dtype=np.float64).reshape(-1, 4)
        first = np.ascontiguousarray(windows[:, :2])
        extent = np.maximum(windows[:, 2:] - 1.0 - first, 0.0)
        count = np.maximum(np.rint(extent / step_px).astype(np.intp) + 1, 2)
        sizes = count.prod(axis=1)
        return cls(first, extent / (count - 1), count, np.cumsum(sizes) - sizes)

    @property
    def vertices(self) -> int:
        """Number of the vertices of all lattices."""
        return int(self.counts.prod(axis=1).sum())


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
        Points, meters, of the wanted vertices in their order.

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
            np.concatenate([surface.knots_u for surface in surfaces]),
            np.concatenate([surface.knots_v for surface in surfaces]),
            np.concatenate([surface.control_points_m.reshape(-1, 3) for surface in surfaces]),
            np.concatenate([surface.weights.ravel() for surface in surfaces]),
            np.array([surface.weights.shape for surface in surfaces], dtype=np.intp),
            lattices,
            wanted,
            points,
        )
    return points


def isolines(
    lattices: Lattices, row_of: NDArray[np.int64], every: int
) -> tuple[NDArray[np.uint32], NDArray[np.intp]]:
    """Return the lines of constant v, then those of constant u, interrupted where a surface is trimmed.

    Parameters
    ----------
    lattices : Lattices
        Of the surfaces.
    row_of : (V,) int64
        Row of each lattice vertex among the kept vertices; -1 for the others.
    every : int
        Distance of lines in rows or columns of a lattice; a smaller lattice has one line near its middle.

    Returns
    -------
    rows : (N,) uint32
        Rows of the kept vertices, line after line.
    sizes : (L,) intp
        Number of vertices of each line, at least two.
    """
    rows, columns = lattices.counts.T
    surface = np.repeat(np.arange(rows.size), rows * columns)
    place = np.arange(surface.size) - lattices.start[surface]
    row, column = np.divmod(place, columns[surface])
    lines, sizes = [], []
    for line, number, order in ((row, rows, place), (column, columns, column * rows[surface] + row)):
        first = np.minimum(every, number - 1) // 2
        chosen = np.flatnonzero((row_of >= 0) & (line % every == first[surface]))
        # Keys of neighbors on a line are consecutive; between two surfaces one is left out.
        key = (lattices.start + np.arange(rows.size))[surface[chosen]] + order[chosen]
        in_order = np.argsort(key)
        chosen, key = chosen[in_order], key[in_order]
        ends = np.flatnonzero(np.diff(key) != 1) + 1
        of_line = np.diff(ends, prepend=0, append=chosen.size)
        lines.append(row_of[chosen][np.repeat(of_line > 1, of_line)])
        sizes.append(of_line[of_line > 1])
    return np.concatenate(lines).astype(np.uint32), np.concatenate(sizes)


@compiled
def _trimmed_triangles(
    labels: U16, label_of: U16, lattices: Lattices, row_of: I64, corners: NDArray[np.uint32]
) -> int:
    """Keep the triangles, two for a cell, at whose centroid the image has the surface's label.

    Fills `row_of` with each vertex's row among those that a triangle needs, -1 for the others, and `corners`
    with such rows; returns the number of triangles.
    """
    row_of[:] = -1
    kept = 0
    first, step = lattices.first, lattices.step
    for surface in range(label_of.size):
        start = lattices.start[surface]
        rows, columns = lattices.counts[surface]
        for row in range(rows - 1):
            for column in range(columns - 1):
                corner = start + row * columns + column
                for third in (1, 2):
                    v = int(np.rint(first[surface, 0] + (row + third / 3.0) * step[surface, 0]))
                    u = int(np.rint(first[surface, 1] + (column + third / 3.0) * step[surface, 1]))
                    if labels[v, u] != label_of[surface]:
                        continue
                    corners[kept, 0] = corner + third - 1
                    corners[kept, 1] = corner + columns
                    corners[kept, 2] = corner + 1 if third == 1 else corner + columns + 1
                    for each in corners[kept]:
                        row_of[each] = 0
                    kept += 1
    needed = 0
    for vertex in range(row_of.size):
        if row_of[vertex] == 0:
            row_of[vertex] = needed
            needed += 1
    for triangle in range(kept):
        for place in range(3):
            corners[triangle, place] = row_of[corners[triangle, place]]
    return kept


@compiled
def _mean_residuals(
    pixels: Intp, residuals_m: F64, sizes: Intp, width: int, lattices: Lattices, row_of: I64, means: F32
) -> None:
    """Average the residuals around each vertex; where there is none, those of the whole fit.

    A surface that was kept from the frame before explains pixels beyond its window, too: no vertex is there.
    """
    total = np.zeros(means.size)
    number = np.zeros(means.size)
    begin = 0
    first, step = lattices.first, lattices.step
    for surface in range(sizes.size):
        start = lattices.start[surface]
        rows, columns = lattices.counts[surface]
        per_row, per_column = 1.0 / max(step[surface, 0], 1e-9), 1.0 / max(step[surface, 1], 1e-9)
        of_fit = 0.0
        for place in range(begin, begin + sizes[surface]):
            of_fit += residuals_m[place]
            v = pixels[place] // width
            u = pixels[place] - v * width
            row = int(np.floor((v - first[surface, 0]) * per_row + 0.5))
            column = int(np.floor((u - first[surface, 1]) * per_column + 0.5))
            if 0 <= row < rows and 0 <= column < columns:
                vertex = row_of[start + row * columns + column]
                if vertex >= 0:
                    total[vertex] += residuals_m[place]
                    number[vertex] += 1.0
        for place in range(start, start + rows * columns):
            vertex = row_of[place]
            if vertex >= 0:
                if number[vertex] > 0:
                    means[vertex] = total[vertex] / number[vertex]
                else:
                    means[vertex] = of_fit / max(sizes[surface], 1)
        begin += sizes[surface]


@compiled
def _normals(vertices: F32, triangles: NDArray[np.uint32], normals: F32) -> None:
    """Add up the normals of each vertex's triangles by area, as unit vectors toward the camera."""
    for triangle in range(triangles.shape[0]):
        a, b, c = (
            vertices[triangles[triangle, 0]],
            vertices[triangles[triangle, 1]],
            vertices[triangles[triangle, 2]],
        )
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        for corner in triangles[triangle]:
            normals[corner, 0] += uy * vz - uz * vy
            normals[corner, 1] += uz * vx - ux * vz
            normals[corner, 2] += ux * vy - uy * vx
    for vertex in range(vertices.shape[0]):
        x, y, z = normals[vertex]
        length = np.sqrt(x * x + y * y + z * z)
        if length == 0.0:
            continue
        px, py, pz = vertices[vertex]
        if x * px + y * py + z * pz > 0.0:
            length = -length
        normals[vertex, 0], normals[vertex, 1], normals[vertex, 2] = x / length, y / length, z / length


@compiled
def _evaluate(
    knots_u: F64,
    knots_v: F64,
    control: F64,
    weights: F64,
    shapes: Intp,
    lattices: Lattices,
    wanted: Bool,
    points: F32,
) -> None:
    """Fill `points`: for each lattice row a curve of homogeneous points, evaluated at the columns."""
    basis_v = np.empty(CUBIC + 1)
    at_u = at_v = net = vertex = done = 0
    first, step, count = lattices.first, lattices.step, lattices.counts
    for surface in range(shapes.shape[0]):
        height, width = shapes[surface]
        curve = np.empty((width, 4))
        bases_u = np.empty((count[surface, 1], CUBIC + 1))
        spans_u = np.empty(count[surface, 1], dtype=np.intp)
        own_u = knots_u[at_u : at_u + width + CUBIC + 1]
        own_v = knots_v[at_v : at_v + height + CUBIC + 1]
        for column in range(count[surface, 1]):
            spans_u[column] = _basis(own_u, first[surface, 1] + column * step[surface, 1], bases_u[column])
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
