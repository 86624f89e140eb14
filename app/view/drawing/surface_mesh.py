"""The fitted surfaces of a frame as one triangle mesh, trimmed to the pixels of their segments."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.view.drawing.frame import SurfaceMesh
from nurbseg.app.view.drawing.surface_samples import Lattices, evaluate_vertices
from nurbseg.drivers.compiled import F32, F64, I64, U16, Intp, compiled
from nurbseg.segmentation.segments import SegmentationTree

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
    shown = [
        (label, leaf.fit, leaf.fit.surface)
        for label, leaf in enumerate(tree.leaves(), start=1)
        if leaf.fit.surface is not None
    ]
    fits = [fit for _, fit, _ in shown]
    surfaces = [surface for _, _, surface in shown]
    label_of = np.array([label for label, _, _ in shown], dtype=np.uint16)
    lattices = Lattices.over(surfaces, step_px)
    first, step, count = lattices.first, lattices.step, lattices.count

    row_of = np.empty(lattices.vertices, dtype=np.int64)
    corners = np.empty((2 * lattices.vertices, 3), dtype=np.uint32)
    cut = _trimmed_triangles(np.ascontiguousarray(labels), label_of, first, step, count, row_of, corners)
    triangles = corners[:cut].copy()
    wanted = row_of >= 0
    vertices = evaluate_vertices(surfaces, lattices, wanted)
    normals = np.zeros_like(vertices)
    _normals(vertices, triangles, normals)
    residuals = np.zeros(len(vertices), dtype=np.float32)
    if fits:
        _mean_residuals(
            np.concatenate([fit.pixels for fit in fits]),
            np.concatenate([fit.residuals_m for fit in fits]),
            np.array([fit.pixels.size for fit in fits], dtype=np.intp),
            labels.shape[1],
            first,
            step,
            count,
            row_of,
            residuals,
        )
    sizes = count[:, 0] * count[:, 1]
    labels_of_vertices = np.repeat(label_of, sizes)[wanted]
    lines = isolines(lattices, row_of, _ISOLINE_EVERY)
    return SurfaceMesh(vertices, normals, triangles, residuals, labels_of_vertices, *lines)


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
    rows, columns = lattices.count.T
    surface = np.repeat(np.arange(rows.size), rows * columns)
    place = np.arange(surface.size) - lattices.start[surface]
    row, column = np.divmod(place, columns[surface])
    lines, sizes = [], []
    for line, number, order in ((row, rows, place), (column, columns, column * rows[surface] + row)):
        first = np.minimum(every, number - 1) // 2
        chosen = np.flatnonzero((row_of >= 0) & (line % every == first[surface]))
        # Keys of neighbours on a line are consecutive; between two surfaces one is left out.
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
    labels: U16, label_of: U16, first: F64, step: F64, count: Intp, row_of: I64, corners: NDArray[np.uint32]
) -> int:
    """Keep the triangles, two for a cell, at whose centroid the image has the surface's label.

    Fills `row_of` with each vertex's row among those that a triangle needs, -1 for the others, and `corners`
    with such rows; returns the number of triangles.
    """
    row_of[:] = -1
    kept = start = 0
    for surface in range(label_of.size):
        rows, columns = count[surface]
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
        start += rows * columns
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
    pixels: Intp,
    residuals_m: F64,
    sizes: Intp,
    width: int,
    first: F64,
    step: F64,
    count: Intp,
    row_of: I64,
    means: F32,
) -> None:
    """Average the residuals around each vertex; where there is none, those of the whole fit.

    A surface that was kept from the frame before explains pixels beyond its window, too: no vertex is there.
    """
    total = np.zeros(means.size)
    number = np.zeros(means.size)
    begin = start = 0
    for surface in range(sizes.size):
        rows, columns = count[surface]
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
                mean = (
                    total[vertex] / number[vertex] if number[vertex] > 0 else of_fit / max(sizes[surface], 1)
                )
                means[vertex] = mean
        begin += sizes[surface]
        start += rows * columns


@compiled
def _normals(vertices: F32, triangles: NDArray[np.uint32], normals: F32) -> None:
    """Add up the normals of each vertex's triangles by area, as unit vectors towards the camera."""
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
