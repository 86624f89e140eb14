"""Registration: one depth image and its color image become a map of colored points."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.segmentation.color_fill import fill_colors

#: Rows handled at once, so that the intermediate images stay in the processor's cache.
_BLOCK_ROWS = 32
#: A point is hidden where another one lands on it in the color image and their parallax differs by more
#: pixels than this. A surface that both cameras see cannot fold by a whole pixel.
_HIDING_PARALLAX_PX = 1.0
#: Points nearer to the color camera than this are no points that a sensor could measure.
_NEAREST_M = 0.01
_METRES = np.arange(1 << 16, dtype=np.float32) * np.float32(1e-3)
_METRES[0] = np.nan


@dataclass(frozen=True, slots=True, eq=False)
class PointMap:
    """An organized point cloud with color, on the depth image's grid.

    The arrays are made read-only, so that one map can be shared between threads without a copy.

    Parameters
    ----------
    points_m : (H, W, 3) float32
        Points in the depth camera's frame, metres; NaN in all three where there is no point.
    color : (H, W, 3) uint8
        RGB of each point, also where it was filled in.
    colored : (H, W) bool
        Where the color camera saw the point itself. False where the point is hidden from it, is so near
        to an outline that the hiding object's color mixes in, or is outside the color image; there
        `color` comes from the nearest points that are not in front of it.

    Attributes
    ----------
    valid : (H, W) bool
        Where there is a point.

    Raises
    ------
    ValueError
        If a shape or dtype is wrong.
    """

    points_m: NDArray[np.float32]
    color: NDArray[np.uint8]
    colored: NDArray[np.bool_]
    valid: NDArray[np.bool_] = field(init=False)

    def __post_init__(self) -> None:
        grid = self.points_m.shape[:2]
        for name, shape, dtype in (
            ("points_m", (*grid, 3), np.float32),
            ("color", (*grid, 3), np.uint8),
            ("colored", grid, np.bool_),
        ):
            array = getattr(self, name)
            if len(grid) != 2 or array.shape != shape or array.dtype != dtype:
                expected = f"{shape} {np.dtype(dtype)}"
                raise ValueError(f"{name}: expected {expected}, got {array.shape} {array.dtype}")
        object.__setattr__(self, "valid", np.isfinite(self.points_m[..., 2]))
        for array in (self.points_m, self.color, self.colored, self.valid):
            array.flags.writeable = False


def register(frame: RGBDFrame) -> PointMap:
    """Give each depth pixel its point in space and its color.

    Depth pixels are back-projected along their undistorted rays; each point is carried into the color
    camera's frame, projected through its lens, held against a z-buffer of all points seen from there,
    and its color is sampled bilinearly. Where depth and color are registered already, pixels of equal
    place belong together and the color image is passed through.

    Parameters
    ----------
    frame : RGBDFrame
        Depth and color, which may differ in size, with the calibration of both cameras.

    Returns
    -------
    PointMap
        On the depth image's grid, in the depth camera's frame.

    Notes
    -----
    What depends on the calibration alone (the rays) is kept for the calibrations used last.
    """
    prepared = _prepared(_Key(frame.calibration))
    return prepared.register(frame)


class _Key:
    """A calibration compared by value, so that sources may make a new one for every frame."""

    __slots__ = ("_values", "calibration")

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self._values = (
            *_values(calibration.depth),
            *_values(calibration.color),
            calibration.color_from_depth.tobytes(),
        )

    def __hash__(self) -> int:
        return hash(self._values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._values == other._values


def _values(camera: Intrinsics) -> tuple[float | bytes, ...]:
    size = (camera.width, camera.height)
    return (*size, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion.tobytes())


@lru_cache(maxsize=4)
def _prepared(key: _Key) -> _Registration:
    return _Registration(key.calibration)


class _Registration:
    """What registration needs of a calibration, computed once."""

    def __init__(self, calibration: Calibration) -> None:
        self._registered = calibration.is_registered
        rays = calibration.depth.rays()
        self._ray_x, self._ray_y = np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
        self._bent = bool(np.isnan(rays).any())
        if self._registered:
            return
        self._color, self._lens = calibration.color, calibration.color.lens()
        rotation = calibration.color_from_depth[:3, :3].astype(np.float32)
        self._translation = calibration.color_from_depth[:3, 3].astype(np.float32)
        # A point z (x, y, 1) of the depth camera is at z * turned + translation for the color camera.
        self._turned = tuple(
            rotation[i, 0] * self._ray_x + rotation[i, 1] * self._ray_y + rotation[i, 2] for i in range(3)
        )
        # The z-buffer's cells are as large as a depth pixel: smaller ones would leave gaps to see through.
        depth_focal = min(calibration.depth.fx, abs(calibration.depth.fy))
        color_focal = min(calibration.color.fx, abs(calibration.color.fy))
        self._cells_per_px = min(1.0, depth_focal / color_focal)
        height, width = calibration.color.height, calibration.color.width
        self._cells = (int(height * self._cells_per_px) + 1, int(width * self._cells_per_px) + 1)
        parallax_px_m = self._cells_per_px * color_focal * float(np.linalg.norm(self._translation))
        self._hiding_per_m = _HIDING_PARALLAX_PX / parallax_px_m if parallax_px_m > 0 else np.inf

    def register(self, frame: RGBDFrame) -> PointMap:
        z = np.take(_METRES, frame.depth_mm)
        x, y = self._ray_x * z, self._ray_y * z
        if self._bent:
            z[np.isnan(x)] = np.nan
        points = np.asarray(cv2.merge([x, y, z]), dtype=np.float32)
        valid = np.isfinite(z)
        if self._registered:
            return PointMap(points, frame.color, valid)
        u, v, nearness, cell = self._project(z)
        colored = self._seen(nearness, cell)
        sampled = cv2.remap(frame.color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        color = np.asarray(cv2.copyTo(sampled, valid.view(np.uint8)), dtype=np.uint8)
        fill_colors(color, colored, valid & ~colored, z, min(self._hiding_per_m, 0.05))
        return PointMap(points, color, colored)

    def _project(
        self, z: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.intp]]:
        """Project every point into the color image.

        Returns
        -------
        u, v : (H, W) float32
            Place in the color image, pixels; anywhere outside it where there is no point.
        nearness : (H, W) float32
            Inverse depth in the color camera's frame, 1/m; 0 where the point is not inside the image.
        cell : (H, W) intp
            Cell of the z-buffer, from 1; 0 where the point is not inside the image.
        """
        u, v, nearness = (np.empty_like(z) for _ in range(3))
        cell = np.empty(z.shape, dtype=np.intp)
        color, (tx, ty, tz), scale = self._color, self._translation, np.float32(self._cells_per_px)
        for start in range(0, len(z), _BLOCK_ROWS):
            rows = slice(start, start + _BLOCK_ROWS)
            depth = z[rows] * self._turned[2][rows]
            depth += tz
            before = depth > _NEAREST_M
            depth[~before] = 1
            inverse = np.reciprocal(depth, out=depth)
            x, y = z[rows] * self._turned[0][rows], z[rows] * self._turned[1][rows]
            for place, offset in ((x, tx), (y, ty)):
                place += offset
                place *= inverse
            # What is far aside is outside in any case; so no later step can overflow.
            x, y = self._lens.bend(np.clip(x, -10, 10, out=x), np.clip(y, -10, 10, out=y))
            np.add(x * color.fx, color.cx, out=u[rows])
            np.add(y * color.fy, color.cy, out=v[rows])
            # Pixel centres are at integers, so that the image begins half a pixel before its first one.
            column, row = u[rows] + np.float32(0.5), v[rows] + np.float32(0.5)
            inside = (column >= 0) & (column < color.width) & (row >= 0) & (row < color.height) & before
            np.multiply(inverse, inside, out=nearness[rows])
            if scale != 1:
                column *= scale
                row *= scale
            # NaN, where there is no point, must not be cast.
            outside = ~inside
            column[outside], row[outside] = 0, 0
            number = row.astype(np.int32)
            number *= self._cells[1]
            number += column.astype(np.int32)
            number += 1
            np.multiply(number, inside, out=cell[rows])
        return u, v, nearness, cell

    def _seen(self, nearness: NDArray[np.float32], cell: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return where a point is inside the color image and no other point stands before it."""
        inside = cell > 0
        if not np.isfinite(self._hiding_per_m):
            return inside
        buffer = np.zeros(1 + self._cells[0] * self._cells[1], dtype=np.float32)
        np.maximum.at(buffer, cell.ravel(), nearness.ravel())
        # Closing shuts the gaps of a surface that the color camera sees stretched. A color is sampled
        # between pixels: so what stands beside a point's own cell, before it, would be mixed in.
        image, around = buffer[1:].reshape(self._cells), np.ones((3, 3), np.uint8)
        closed = cv2.morphologyEx(image, cv2.MORPH_CLOSE, around)
        buffer[1:] = cv2.dilate(closed, around).ravel()
        return inside & (np.take(buffer, cell) - nearness <= self._hiding_per_m)
