"""The grid on which splits are decided: points of every few rows and columns, and their inverse depths."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, Bool, Intp, compiled
from nurbseg.segmentation.config import REFERENCE_PIXELS, REFERENCE_WIDTH
from nurbseg.segmentation.points.rays import Rays
from nurbseg.segmentation.points.registration import PointMap

#: Columns of the grid where no step is set, about; narrower images are used at every pixel.
_GRID_WIDTH = 320

Window = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class PixelGrid:
    """Points on every `step`-th row and column of an image, laid out for matrix products.

    Parameters
    ----------
    step : int
        Distance of neighbors on the grid, pixels.
    image_shape : (int, int)
        Rows and columns of the full image.
    coordinates_m : (3, h, w) float32
        x, y, z in meters; 0 where there is no point.
    valid : (h, w) bool
        Where there is a point.
    """

    step: int
    image_shape: tuple[int, int]
    coordinates_m: NDArray[np.float32]
    valid: NDArray[np.bool_]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        height, width = self.valid.shape
        return height, width

    @property
    def pixel_share(self) -> float:
        """Grid pixels for each pixel of a 640x480 image, the unit of the paper's thresholds."""
        return self.image_shape[0] * self.image_shape[1] / REFERENCE_PIXELS / self.step**2

    def window_mask(self, grid_pixels: NDArray[np.intp]) -> tuple[Window, NDArray[np.bool_]]:
        """Return the tight window of flat grid pixels, and which of its pixels they are."""
        rows, columns = np.divmod(grid_pixels, self.shape[1])
        top, left, bottom, right = rows[0], columns.min(), rows[-1] + 1, columns.max() + 1
        mask = np.zeros((bottom - top, right - left), dtype=np.bool_)
        mask[rows - top, columns - left] = True
        return (int(top), int(left), int(bottom), int(right)), mask

    def pixels(self, grid_pixels: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the flat indices into the full image of flat indices of grid pixels."""
        width = self.shape[1]
        return (grid_pixels + grid_pixels // width * (self.image_shape[1] - width)) * self.step

    def every_second(self, grid_pixels: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return those of some flat grid pixels that are on even rows and columns."""
        return _every_second(grid_pixels, self.shape[1])

    def full_window(self, window: Window) -> Window:
        """Return a window of the grid in pixels of the full image."""
        top, left, bottom, right = window
        return (
            top * self.step,
            left * self.step,
            (bottom - 1) * self.step + 1,
            (right - 1) * self.step + 1,
        )


@dataclass(frozen=True, slots=True, eq=False)
class DepthGrid(PixelGrid):
    """A grid of points with their inverse depths, which is what a triangulating camera measures.

    Parameters
    ----------
    inverse_depth : (h, w) float32
        Inverse depth, 1/m; 0 where there is no point.
    rays : Rays
        Of the camera.
    distances_m : (h, w) float32
        From the camera, meters; 0 where there is no point.
    """

    inverse_depth: NDArray[np.float32]
    rays: Rays
    distances_m: NDArray[np.float32]

    @property
    def unit_px(self) -> float:
        """Pixels of this image per pixel of a 640-wide one, the unit of settings."""
        return self.image_shape[1] / REFERENCE_WIDTH


@compiled
def _every_second(grid_pixels: Intp, width: int) -> Intp:
    found = np.empty(grid_pixels.size, dtype=np.intp)
    count, row = 0, 0
    for pixel in grid_pixels:
        # Grid pixels ascend; a division is slower.
        while pixel >= (row + 1) * width:
            row += 1
        found[count] = pixel
        count += ((row | (pixel - row * width)) & 1) == 0
    return found[:count].copy()


def union(parts: Sequence[NDArray[np.intp]]) -> NDArray[np.intp]:
    """Return the pixels of parts that share none, each ascending, in ascending order."""
    # Stable sorting merges ascending runs.
    return np.sort(np.concatenate(parts), kind="stable")


def decimated_grid(cloud: PointMap, step: int) -> PixelGrid:
    """Take every `step`-th row and column of a frame."""
    return PixelGrid(step, cloud.valid.shape, *_decimated(cloud.points_m, cloud.valid, step))


@compiled
def _decimated(points_m: F32, valid: Bool, step: int) -> tuple[F32, Bool]:
    height, width = -(-valid.shape[0] // step), -(-valid.shape[1] // step)
    coordinates_m = np.empty((3, height, width), dtype=np.float32)
    there = np.empty((height, width), dtype=np.bool_)
    for row in range(height):
        for column in range(width):
            there[row, column] = valid[row * step, column * step]
            for axis in range(3):
                coordinate = points_m[row * step, column * step, axis]
                coordinates_m[axis, row, column] = coordinate if there[row, column] else np.float32(0.0)
    return coordinates_m, there


def depth_grid(cloud: PointMap, step: int) -> DepthGrid:
    """Take every `step`-th row and column of a frame: its points and their inverse depths."""
    coordinates_m, valid = _decimated(cloud.points_m, cloud.valid, step)
    inverse_depth, distances_m = _inverse_depths(coordinates_m[2], valid), _distances(coordinates_m)
    return DepthGrid(step, cloud.valid.shape, coordinates_m, valid, inverse_depth, cloud.rays, distances_m)


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


def grid_step(valid: NDArray[np.bool_], decimation: int) -> int:
    """Return the step of the grid on which splits are decided, pixels.

    Parameters
    ----------
    valid : (H, W) bool
        Pixels that have a point.
    decimation : int
        The setting: the step, or 0 for about 320 columns on the grid, and 1 for small images.

    Returns
    -------
    int
        1 if that grid would hold no point although the image does.
    """
    width = valid.shape[1]
    step = decimation or (1 if width <= _GRID_WIDTH else max(2, round(width / _GRID_WIDTH)))
    # Row by row, as the first ones with points say all.
    return step if any(row[::step].any() for row in valid[::step]) or not valid.any() else 1
