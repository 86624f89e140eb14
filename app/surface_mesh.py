"""The fitted surfaces of a frame as one triangle mesh, trimmed to the pixels of their segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.surface_samples import Lattices, evaluate_vertices
from nurbseg.segmentation.surface import Fit
from nurbseg.segmentation.tree import SegmentationTree


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMesh:
    """Triangles on the fitted surfaces of all leaves.

    Parameters
    ----------
    vertices_m : (V, 3) float32
        Points on the surfaces, metres, in the depth camera's frame.
    normals : (V, 3) float32
        Unit normals that look towards the camera.
    triangles : (T, 3) uint32
        Rows of `vertices_m`.
    residuals_m : (V,) float32
        Mean distance of the data around each vertex to the surface, metres.
    labels : (V,) uint16
        Label of the segment that each vertex belongs to.
    """

    vertices_m: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    residuals_m: NDArray[np.float32]
    labels: NDArray[np.uint16]


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
    surface, row, column = lattices.places()

    triangles = _trimmed_triangles(lattices, surface, row, column, label_of, labels)
    used = np.zeros(surface.size, dtype=np.bool_)
    used[triangles] = True
    renumbered = np.cumsum(used, dtype=np.int64) - 1
    triangles = renumbered[triangles]

    vertices = evaluate_vertices(surfaces, lattices, surface[used], row[used], column[used])
    return SurfaceMesh(
        vertices_m=vertices,
        normals=_normals(vertices, triangles),
        triangles=triangles.astype(np.uint32),
        residuals_m=_mean_residuals(fits, lattices, labels.shape[1], surface.size)[used],
        labels=label_of[surface[used]],
    )


def _trimmed_triangles(
    lattices: Lattices,
    surface: NDArray[np.intp],
    row: NDArray[np.intp],
    column: NDArray[np.intp],
    label_of: NDArray[np.uint16],
    labels: NDArray[np.uint16],
) -> NDArray[np.intp]:
    """Return the triangles, two for a cell, at whose centroid the image has the surface's label."""
    columns = lattices.count[surface, 1]
    corner = np.flatnonzero((row < lattices.count[surface, 0] - 1) & (column < columns - 1))
    of = surface[corner]
    below = corner + columns[corner]
    at = np.stack([row[corner], column[corner]], axis=-1)
    kept = []
    for third, triangle in ((1 / 3, (corner, below, corner + 1)), (2 / 3, (corner + 1, below, below + 1))):
        place = np.rint(lattices.first[of] + (at + third) * lattices.step[of]).astype(np.intp)
        inside = labels[place[:, 0], place[:, 1]] == label_of[of]
        kept.append(np.stack([each[inside] for each in triangle], axis=-1))
    return np.concatenate(kept)


def _mean_residuals(
    fits: Sequence[Fit], lattices: Lattices, width: int, vertices: int
) -> NDArray[np.float32]:
    """Average the residuals around each vertex; where there is none, those of the whole fit.

    A surface carried over from the frame before explains pixels beyond its window, too: no vertex is there.
    """
    if not fits:
        return np.zeros(0, dtype=np.float32)
    sizes = [fit.pixels.size for fit in fits]
    of = np.repeat(np.arange(len(fits)), sizes)
    residuals = np.concatenate([fit.residuals_m for fit in fits])
    rows, columns = np.divmod(np.concatenate([fit.pixels for fit in fits]), width)
    scale = 1.0 / np.maximum(lattices.step, 1e-9)
    nearest = [
        np.floor((at - lattices.first[of, axis]) * scale[of, axis] + 0.5).astype(np.intp)
        for axis, at in enumerate((rows, columns))
    ]
    inside = np.ones(of.size, dtype=np.bool_)
    for axis in (0, 1):
        inside &= (nearest[axis] >= 0) & (nearest[axis] < lattices.count[of, axis])
    vertex = (lattices.start[of] + nearest[0] * lattices.count[of, 1] + nearest[1])[inside]
    count = np.bincount(vertex, minlength=vertices)
    total = np.bincount(vertex, weights=residuals[inside], minlength=vertices)
    means = np.array([fit.residuals_m.mean() for fit in fits])
    mean = np.repeat(means, lattices.count[:, 0] * lattices.count[:, 1])
    np.divide(total, count, out=mean, where=count > 0)
    return mean.astype(np.float32)


def _normals(vertices: NDArray[np.float32], triangles: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the unit normal of each vertex, the mean of its triangles' by area, towards the camera."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    (ux, uy, uz), (vx, vy, vz) = (b - a).T, (c - a).T
    corners = triangles.T.ravel()
    normals = np.empty((len(vertices), 3), dtype=np.float32)
    for axis, along in enumerate((uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)):
        normals[:, axis] = np.bincount(corners, weights=np.tile(along, 3), minlength=len(vertices))
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    length[length == 0] = 1.0
    length[np.einsum("ij,ij->i", normals, vertices) > 0] *= -1.0
    normals /= length[:, np.newaxis]
    return normals


__all__ = ["SurfaceMesh", "surface_mesh"]
