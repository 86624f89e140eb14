"""What is measured of an object: position, size, orientation, color, errors, and how sure all that is."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, Intp, compiled
from nurbseg.common.frame import Intrinsics, RGBDFrame
from nurbseg.library.boxes.boxes import OrientedBox
from nurbseg.library.boxes.support import Support
from nurbseg.library.meshing import surface_mesh
from nurbseg.library.surface_mesh import SurfaceMesh
from nurbseg.segmentation.config import REFERENCE_PIXELS
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.surface import NurbsSurface, normals
from nurbseg.segmentation.vocabulary import StopReason

#: Number of normals of a surface that are averaged.
_NORMALS = 100
#: Beyond these an object is not sure: residuals over the sensor's noise, and the hidden share of its border.
_ROUGH, _HIDDEN = 3.0, 0.5
#: The farthest points, as a share of all, say nothing of the fit: edges mix points with what is behind.
_FARTHEST = 0.05
#: Pixels of a 640x480 image that a sure object has at least.
_PIXELS_MIN = 100


class SegmentedFrame(Protocol):
    """A frame whose objects are measured."""

    @property
    def frame(self) -> RGBDFrame:
        """As it was captured."""

    @property
    def cloud(self) -> PointMap:
        """Its points."""

    @property
    def tree(self) -> SegmentationTree:
        """Its segments."""

    @property
    def object_of_leaf(self) -> NDArray[np.uint16]:
        """Label of each leaf's object, by the leaf's position from 1 on."""


@dataclass(frozen=True, slots=True)
class Track:
    """What earlier frames say of an object.

    Parameters
    ----------
    velocity_m_s : (float, float, float)
        Of its center along the axes of the camera: against what is at rest if there is a support or the
        pose of the camera is known, else against the camera.
    seen_s : float
        Time since the first frame of its label, seconds; 0 in a frame alone.
    """

    velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seen_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LostObject:
    """An object that is not seen any more: its label, and the time since it was seen last, seconds."""

    label: int
    lost_s: float


@dataclass(frozen=True, slots=True)
class Sigma:
    """Standard deviations of the errors of a box that is whole.

    Parameters
    ----------
    center_m, size_m : float
        Of each coordinate of the center, and of each side, meters.
    yaw_rad : float
        Of the turn about the box's height, radians; pi / 2 if nothing is known of it.
    """

    center_m: float
    size_m: float
    yaw_rad: float


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredObject:
    """An object of a frame, or a surface if surfaces are not merged into objects.

    Parameters
    ----------
    label : int
        Label in the label image of the objects.
    leaves : tuple of str
        Names of its surfaces.
    box : OrientedBox
        Upright on the support if there is one. An object that is seen down to near the support reaches it.
        Where frames continue each other, its axes keep their order and sign, and all of it is filtered.
    visible : OrientedBox
        The same of the points of this frame alone, as far as they go.
    sigma : Sigma
        Standard deviations of the box's errors.
    track : Track
        What earlier frames say.
    hidden_share : float
        Share of its border that is at an edge of the image or behind what it does not enclose, 0 to 1.
    noise_m : float
        The sensor's noise at its distance, meters.
    support : Support or None
        The plane that the objects of the frame stand on.
    cloud : PointMap
        Points of the frame.
    tree : SegmentationTree
        Tree of the frame.
    camera : Intrinsics
        The depth camera.
    """

    label: int
    leaves: tuple[str, ...]
    box: OrientedBox
    visible: OrientedBox
    sigma: Sigma
    track: Track
    hidden_share: float
    noise_m: float
    support: Support | None
    cloud: PointMap
    tree: SegmentationTree
    camera: Intrinsics

    def __repr__(self) -> str:
        sizes = " x ".join(f"{size:.3f}" for size in self.box.size_m.tolist())
        distance_m = float(np.linalg.norm(self.centroid_m))
        return f"MeasuredObject({self.label}, {self.pixels.size} pixels, {sizes} m, {distance_m:.3f} m away)"

    @property
    def camera_from_object(self) -> NDArray[np.float64]:
        """Pose (4, 4) of its box in the camera's frame, meters."""
        return self.box.camera_from_box

    @property
    def support_from_object(self) -> NDArray[np.float64] | None:
        """Pose (4, 4) of its box in the frame of the support, meters; None without a support."""
        return None if self.support is None else self.support.support_from_camera @ self.camera_from_object

    @property
    def pending(self) -> bool:
        """Whether one of its surfaces is to be split in one of the next frames of a live tree."""
        return any(leaf.stop is StopReason.PENDING for leaf in self._segments)

    @property
    def is_sure(self) -> bool:
        """Whether its box can be trusted: it is explained and largely seen, and it is known what is up."""
        is_upright = self.support is None or self.support.is_sure
        return self.is_explained and self.hidden_share < _HIDDEN and is_upright

    @property
    def is_explained(self) -> bool:
        """Whether its surfaces fit, it is not tiny, and none of it is pending; its box may be wrong."""
        pixels = sum(leaf.pixels.size for leaf in self._segments)
        is_tiny = pixels * REFERENCE_PIXELS < _PIXELS_MIN * math.prod(self.tree.shape)
        return self.rms_over_noise < _ROUGH and not is_tiny and not self.pending

    @property
    def rms_over_noise(self) -> float:
        """Its fit error over the sensor's noise at its distance; about 1 where surfaces explain all."""
        return 0.0 if self.fit_error_m is None else self.fit_error_m / self.noise_m

    @cached_property
    def _segments(self) -> tuple[Segment, ...]:
        return tuple(self.tree[name] for name in self.leaves)

    @property
    def surfaces(self) -> Iterator[tuple[Segment, NurbsSurface]]:
        """Its leaves that have pixels and a surface, and these."""
        for leaf in self._segments:
            if leaf.fit.surface is not None and leaf.pixels.size:
                yield leaf, leaf.fit.surface

    @cached_property
    def pixels(self) -> NDArray[np.intp]:
        """Flat indices of its pixels, (N,) ascending."""
        return np.sort(np.concatenate([leaf.pixels for leaf in self._segments]))

    @cached_property
    def points_m(self) -> NDArray[np.float32]:
        """Its points, (N, 3) meters, in the depth camera's frame: x right, y down, z forward."""
        return self.cloud.points_m.reshape(-1, 3).take(self.pixels, axis=0)

    @cached_property
    def colors(self) -> NDArray[np.uint8]:
        """Color of each point, (N, 3) RGB."""
        return self.cloud.color.reshape(-1, 3).take(self.pixels, axis=0)

    @cached_property
    def centroid_m(self) -> NDArray[np.float64]:
        """Mean of its points, (3,) meters."""
        points_m = self.cloud.points_m.reshape(-1, 3)
        # In any order, as sorting costs far more than the sum.
        total = sum(_point_sum(points_m, leaf.pixels) for leaf in self._segments)
        return np.asarray(total / sum(leaf.pixels.size for leaf in self._segments))

    @cached_property
    def mean_color(self) -> NDArray[np.float64]:
        """Mean of its colors, (3,) RGB from 0 to 255."""
        return np.asarray(self.colors.mean(axis=0, dtype=np.float64))

    @cached_property
    def mean_normal(self) -> NDArray[np.float64] | None:
        """Mean of the normals of its surfaces, (3,), a unit vector towards the camera; None without one."""
        total = np.zeros(3)
        for leaf, surface in self.surfaces:
            v, u = np.divmod(leaf.pixels[:: -(-leaf.pixels.size // _NORMALS)], self.tree.shape[1])
            found = normals(surface, u, v)
            total -= np.nansum(found, axis=0) * (leaf.pixels.size / u.size)
        length = np.linalg.norm(total)
        return total / length if length > 0 else None

    @cached_property
    def rms_m(self) -> float | None:
        """Root mean square of the distances of its points to its surfaces, meters; None without one."""
        residuals_m = self._residuals_m
        return float(np.sqrt(np.mean(np.square(residuals_m)))) if residuals_m.size else None

    @cached_property
    def fit_error_m(self) -> float | None:
        """The same without the farthest 5 % of its points, which may be mixed with what is behind."""
        count = math.ceil((1.0 - _FARTHEST) * self._residuals_m.size)
        nearest = np.partition(self._residuals_m, count - 1)[:count] if count else self._residuals_m
        return float(np.sqrt(np.mean(np.square(nearest)))) if count else None

    @cached_property
    def _residuals_m(self) -> NDArray[np.float64]:
        fits = [leaf.fit for leaf in self._segments if leaf.fit.surface is not None]
        return np.concatenate([np.zeros(0), *(fit.residuals_m for fit in fits)])

    @property
    def name(self) -> str:
        """Its name in files: ``object 3``, or ``surface 3`` where surfaces are not merged."""
        return f"{'object' if self.tree.objects else 'surface'} {self.label}"

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

    def export(self, path: str | Path) -> None:
        """Write its surfaces as a 3-D model, as `FrameResult.export` does those of all objects."""
        from nurbseg.library.models.model import export

        export([self], path)


@compiled
def _point_sum(points_m: F32, pixels: Intp) -> F64:
    """Return the sum of the points (N, 3) of some pixels."""
    total = np.zeros(3)
    for pixel in pixels:
        for axis in range(3):
            total[axis] += points_m[pixel, axis]
    return total
