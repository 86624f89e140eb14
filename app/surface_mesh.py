"""The fitted surfaces of a frame as one triangle mesh, trimmed to the pixels of their segments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.surface import NurbsSurface, evaluate_lattice
from nurbseg.segmentation.tree import Segment, SegmentationTree


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
    parts: list[SurfaceMesh] = []
    first = 0
    for label, leaf in enumerate(tree.leaves(), start=1):
        if leaf.fit.surface is None:
            continue
        part = _patch(leaf, leaf.fit.surface, labels, label, step_px, first)
        parts.append(part)
        first += len(part.vertices_m)
    if not parts:
        none = np.zeros((0, 3), dtype=np.float32)
        return SurfaceMesh(
            none,
            none,
            np.zeros((0, 3), dtype=np.uint32),
            np.zeros(0, dtype=np.float32),
            np.zeros(0, dtype=np.uint16),
        )
    return SurfaceMesh(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("vertices_m", "normals", "triangles", "residuals_m", "labels")
        )
    )


def _patch(
    leaf: Segment,
    surface: NurbsSurface,
    labels: NDArray[np.uint16],
    label: int,
    step_px: float,
    first: int,
) -> SurfaceMesh:
    """Sample one surface; triangles count vertices from `first`."""
    top, left, bottom, right = surface.window
    v, u = _stops(top, bottom, step_px), _stops(left, right, step_px)
    points = evaluate_lattice(surface, u, v)
    index = np.arange(v.size * u.size, dtype=np.int64).reshape(v.size, u.size)

    # Two triangles for a cell; each stays if the segment has the pixel at its centroid.
    corner, right_of, below, across = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    v_cell, u_cell = v[:-1], u[:-1]
    dv, du = np.diff(v), np.diff(u)
    kept = []
    for third, triangle in ((1 / 3, (corner, below, right_of)), (2 / 3, (right_of, below, across))):
        rows = np.rint(v_cell + third * dv).astype(np.intp)
        columns = np.rint(u_cell + third * du).astype(np.intp)
        inside = labels[np.ix_(rows, columns)] == label
        kept.append(np.stack([each[inside] for each in triangle], axis=-1))
    triangles = np.concatenate(kept)

    used = np.zeros(index.size, dtype=np.bool_)
    used[triangles] = True
    new_index = np.cumsum(used) - 1 + first
    residuals = _mean_residuals(leaf, labels.shape[1], v, u)
    return SurfaceMesh(
        vertices_m=points.reshape(-1, 3)[used].astype(np.float32),
        normals=_normals(points).reshape(-1, 3)[used],
        triangles=new_index[triangles].astype(np.uint32),
        residuals_m=residuals[used],
        labels=np.full(int(used.sum()), label, dtype=np.uint16),
    )


def _stops(start: int, end: int, step_px: float) -> NDArray[np.float64]:
    """Return evenly spaced positions from the first to the last pixel; at least two."""
    return np.linspace(start, max(end - 1, start), max(2, round((end - 1 - start) / step_px) + 1))


def _mean_residuals(
    leaf: Segment, width: int, v: NDArray[np.float64], u: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Average the residuals around each vertex of the lattice; where none is, those of the leaf."""
    rows, columns = np.divmod(leaf.fit.pixels, width)
    nearest = [
        np.rint((at - stops[0]) / max(stops[1] - stops[0], 1e-9)).astype(np.intp).clip(0, stops.size - 1)
        for at, stops in ((rows, v), (columns, u))
    ]
    vertex = nearest[0] * u.size + nearest[1]
    count = np.bincount(vertex, minlength=v.size * u.size)
    total = np.bincount(vertex, weights=leaf.fit.residuals_m, minlength=v.size * u.size)
    mean = np.full(count.size, leaf.fit.residuals_m.mean(), dtype=np.float32)
    np.divide(total, count, out=mean, where=count > 0, casting="same_kind")
    return mean


def _normals(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return unit normals of a lattice of points, by differences; towards the camera at the origin."""
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0)).astype(np.float32)
    away = np.einsum("ijk,ijk->ij", normals, points) > 0
    length = np.linalg.norm(normals, axis=-1)
    length[length == 0] = 1.0
    length[away] *= -1.0
    unit: NDArray[np.float32] = normals / length[..., np.newaxis]
    return unit


__all__ = ["SurfaceMesh", "surface_mesh"]
