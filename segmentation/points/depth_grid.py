"""Grids of points with their inverse depths, which is what a triangulating camera measures."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F32, Bool, compiled
from nurbseg.segmentation.config import REFERENCE_WIDTH
from nurbseg.segmentation.points.grid import PixelGrid, decimated_grid
from nurbseg.segmentation.points.rays import Rays
from nurbseg.segmentation.points.registration import PointMap


@dataclass(frozen=True, slots=True, eq=False)
class DepthGrid:
    """A grid of points with their inverse depths.

    Parameters
    ----------
    points : PixelGrid
        The points.
    inverse_depth : (h, w) float32
        Inverse depth, 1/m; 0 where there is no point.
    rays : Rays
        Of the camera.

    Attributes
    ----------
    distances_m : (h, w) float32
        From the camera, metres; 0 or NaN where there is no point.
    """

    points: PixelGrid
    inverse_depth: NDArray[np.float32]
    rays: Rays
    distances_m: NDArray[np.float32] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "distances_m", _distances(self.points.coordinates_m))

    @property
    def step(self) -> int:
        """Pixels from one grid pixel to the next."""
        return self.points.step

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Where there is a point, (h, w) bool."""
        return self.points.valid

    @property
    def unit_px(self) -> float:
        """Pixels of this image per pixel of a 640-wide one, the unit of settings."""
        return self.points.image_shape[1] / REFERENCE_WIDTH


@compiled
def _distances(coordinates_m: F32) -> F32:
    _, height, width = coordinates_m.shape
    distances_m = np.empty((height, width), dtype=np.float32)
    for row in range(height):
        for column in range(width):
            square = np.float32(0.0)
            for axis in range(3):
                square += coordinates_m[axis, row, column] * coordinates_m[axis, row, column]
            distances_m[row, column] = np.sqrt(square)
    return distances_m


def depth_grid(cloud: PointMap, step: int) -> DepthGrid:
    """Take every `step`-th row and column of a frame: its points and their inverse depths."""
    points = decimated_grid(cloud, step)
    return DepthGrid(points, _inverse_depths(points.coordinates_m[2], points.valid), cloud.rays)


def inverse_depth_image(cloud: PointMap) -> NDArray[np.float32]:
    """Return one over depth of every pixel, (H, W) float32 in 1/m; 0 where there is no point."""
    return _inverse_depths(cloud.points_m[..., 2], cloud.valid)


@compiled
def _inverse_depths(depth_m: F32, valid: Bool) -> F32:
    height, width = valid.shape
    inverse_depth = np.empty((height, width), dtype=np.float32)
    for y in range(height):
        for x in range(width):
            usable = valid[y, x] and depth_m[y, x] > 0
            inverse_depth[y, x] = np.float32(1.0) / depth_m[y, x] if usable else np.float32(0.0)
    return inverse_depth
