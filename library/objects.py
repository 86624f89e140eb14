"""Measures the objects of a frame: position, size, orientation, color, and errors of their surfaces."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.boxes import OrientedBox
from nurbseg.library.meshing import surface_mesh
from nurbseg.library.surface_mesh import SurfaceMesh
from nurbseg.segmentation.blas import one_blas_thread
from nurbseg.segmentation.labels.images import apply_lookup_table, by_label
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.surface import normals
from nurbseg.segmentation.vocabulary import StopReason

#: Number of normals of a surface that are averaged.
_NORMALS = 100


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MeasuredObject:
    """An object of a frame, or a surface if surfaces are not merged into objects.

    Parameters
    ----------
    label : int
        Label in the label image of the objects.
    leaves : tuple of str
        Names of its surfaces.
    pixels : (N,) intp
        Flat indices into the image, ascending.
    points_m : (N, 3) float32
        Its points, meters, in the depth camera's frame: x right, y down, z forward.
    colors : (N, 3) uint8
        RGB of each point.
    box : OrientedBox
        Box around its points.
    mean_normal : (3,) float64 or None
        Mean of the normals of its surfaces, a unit vector toward the camera; None without a surface.
    rms_m : float or None
        Root mean square of the distances of its points to its surfaces, meters; None without a surface.
    tree : SegmentationTree
        Tree of the frame.
    """

    label: int
    leaves: tuple[str, ...]
    pixels: NDArray[np.intp]
    points_m: NDArray[np.float32]
    colors: NDArray[np.uint8]
    box: OrientedBox
    mean_normal: NDArray[np.float64] | None
    rms_m: float | None
    tree: SegmentationTree

    def __repr__(self) -> str:
        sizes = " x ".join(f"{size:.3f}" for size in self.box.size_m.tolist())
        distance_m = float(np.linalg.norm(self.centroid_m))
        return f"MeasuredObject({self.label}, {self.pixels.size} pixels, {sizes} m, {distance_m:.3f} m away)"

    @property
    def pending(self) -> bool:
        """Whether one of its surfaces is to be split in one of the next frames of a live tree."""
        return any(self.tree[name].stop is StopReason.PENDING for name in self.leaves)

    @property
    def centroid_m(self) -> NDArray[np.float64]:
        """Mean of its points, (3,) meters."""
        return np.asarray(self.points_m.mean(axis=0, dtype=np.float64))

    @property
    def mean_color(self) -> NDArray[np.float64]:
        """Mean of its colors, (3,) RGB from 0 to 255."""
        return np.asarray(self.colors.mean(axis=0, dtype=np.float64))

    def mesh(self, step_px: float = 2.0) -> SurfaceMesh:
        """Return its surfaces as triangles, trimmed to its pixels.

        Parameters
        ----------
        step_px : float
            Distance of the lattice's rows and columns, pixels.
        """
        own = np.zeros(self.tree.shape, dtype=np.uint16)
        own.flat[self.pixels] = self.tree.labels("surfaces").flat[self.pixels]
        return surface_mesh(self.tree, own, step_px)


@one_blas_thread()
def measure_objects(
    cloud: PointMap, tree: SegmentationTree, object_of_leaf: NDArray[np.uint16]
) -> tuple[MeasuredObject, ...]:
    """Measure the objects of a frame that have pixels.

    Parameters
    ----------
    cloud : PointMap
        The frame's points.
    tree : SegmentationTree
        Its segments.
    object_of_leaf : (L + 1,) uint16
        Label of each leaf's object, by the leaf's position from 1 on; 0 at position 0.

    Returns
    -------
    tuple of MeasuredObject
        In the order of their labels.
    """
    leaf_image = tree.labels("surfaces")
    labels = apply_lookup_table(object_of_leaf, leaf_image).ravel()
    order, bounds = by_label(labels, int(object_of_leaf.max()) + 1)
    points, colors = cloud.points_m.reshape(-1, 3), cloud.color.reshape(-1, 3)
    leaves = tree.leaves()
    measured = []
    for label in (np.flatnonzero(np.diff(bounds)[1:]) + 1).tolist():
        pixels = order[bounds[label] : bounds[label + 1]]
        own = [leaf for leaf, of in zip(leaves, object_of_leaf[1:], strict=True) if of == label]
        residuals = [leaf.fit.residuals_m for leaf in own if leaf.fit.surface is not None]
        residuals_m = np.concatenate([np.zeros(0), *residuals])
        measured.append(
            MeasuredObject(
                label=label,
                leaves=tuple(leaf.name for leaf in own),
                pixels=pixels,
                points_m=points[pixels],
                colors=colors[pixels],
                box=OrientedBox.around(points[pixels]),
                mean_normal=_mean_normal(own, tree.shape[1]),
                rms_m=float(np.sqrt(np.mean(residuals_m**2))) if residuals_m.size else None,
                tree=tree,
            )
        )
    return tuple(measured)


def _mean_normal(leaves: Sequence[Segment], width: int) -> NDArray[np.float64] | None:
    """Return the mean normal at a sample of pixels of each leaf, weighted by size."""
    total = np.zeros(3)
    for leaf in leaves:
        if leaf.fit.surface is None or not leaf.pixels.size:
            continue
        v, u = np.divmod(leaf.pixels[:: -(-leaf.pixels.size // _NORMALS)], width)
        found = normals(leaf.fit.surface, u, v)
        total -= np.nansum(found, axis=0) * (leaf.pixels.size / u.size)
    length = np.linalg.norm(total)
    return total / length if length > 0 else None
