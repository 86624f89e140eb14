"""The grid of pixels on which splits are decided: every pixel of the image, or every few."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.registration import PointMap

Window = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class PixelGrid:
    """Points on every `step`-th row and column of an image, laid out for matrix products.

    Parameters
    ----------
    step : int
        Distance of neighbours on the grid, pixels.
    image_shape : (int, int)
        Rows and columns of the full image.
    coordinates_m : (3, h, w) float32
        x, y, z in metres; 0, or NaN on a full grid, where there is no point.
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
        """Places of the grid for each pixel of a 640x480 image, the unit of the paper's thresholds."""
        return self.image_shape[0] * self.image_shape[1] / (640 * 480) / self.step**2

    def locate(self, places: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp], Window]:
        """Return rows, columns and the tight window (one past the last) of ascending flat places."""
        rows, columns = np.divmod(places, self.shape[1])
        return (
            rows,
            columns,
            (int(rows[0]), int(columns.min()), int(rows[-1]) + 1, int(columns.max()) + 1),
        )

    def window_mask(self, places: NDArray[np.intp]) -> tuple[Window, NDArray[np.bool_]]:
        """Return the tight window of flat places and which of its places they are."""
        flat = np.zeros(self.valid.size, dtype=np.bool_)
        flat[places] = True
        image = flat.reshape(self.valid.shape)
        rows, columns = np.flatnonzero(image.any(axis=1)), np.flatnonzero(image.any(axis=0))
        top, left, bottom, right = int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1
        return (top, left, bottom, right), image[top:bottom, left:right]

    def pixels(self, places: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the flat indices into the full image of flat places of the grid."""
        if self.step == 1:
            return places
        rows, columns = np.divmod(places, self.shape[1])
        return (rows * self.image_shape[1] + columns) * self.step

    def every_second(self, places: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return those of some flat places that are on even rows and columns."""
        rows, columns = np.divmod(places, self.shape[1])
        found: NDArray[np.intp] = places[((rows | columns) & 1) == 0]
        return found

    def full_window(self, window: Window) -> Window:
        """Return a window of the grid in pixels of the full image."""
        top, left, bottom, right = window
        return (
            top * self.step,
            left * self.step,
            (bottom - 1) * self.step + 1,
            (right - 1) * self.step + 1,
        )


def decimated_grid(cloud: PointMap, step: int) -> PixelGrid:
    """Take every `step`-th row and column of a frame.

    Parameters
    ----------
    cloud : PointMap
        The frame.
    step : int
        Pixels from one row or column to the next.

    Returns
    -------
    PixelGrid
        Its points and which of them there are.
    """
    valid = np.ascontiguousarray(cloud.valid[::step, ::step])
    points = cloud.points_m[::step, ::step]
    coordinates = np.zeros((3, *valid.shape), dtype=np.float32)
    for axis in range(3):
        np.copyto(coordinates[axis], points[..., axis], where=valid)
    height, width = cloud.valid.shape
    return PixelGrid(step, (height, width), coordinates, valid)


def full_grid(cloud: PointMap) -> PixelGrid:
    """Take every pixel of a frame, without copying; coordinates are NaN where there is no point."""
    height, width = cloud.valid.shape
    return PixelGrid(1, (height, width), np.moveaxis(cloud.points_m, -1, 0), cloud.valid)


__all__ = ["PixelGrid", "Window", "decimated_grid", "full_grid"]
