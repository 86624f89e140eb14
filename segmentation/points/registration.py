"""Registration of a depth image and its color image to a map of colored points."""

from dataclasses import dataclass, field
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, I32, U8, U16, Bool, compiled, inlined
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.segmentation.points.rays import Rays, rays_through

#: A point is hidden where another one lands on it in the color image and their parallax differs by more
#: pixels than this. A surface that both cameras see cannot fold by a whole pixel.
_HIDING_PARALLAX_PX = 1.0
#: Least depth in the color camera's frame, meters: nothing nearer could be measured.
_NEAREST_M = np.float32(0.01)
_METRES_PER_MM = np.float32(1e-3)
#: Limit of x / z and y / z, outside any image, so that no step of the projection overflows.
_FAR_ASIDE = np.float32(10.0)

#: A tuple, not an array, so that loops over pixels keep the numbers in registers.
Numbers: TypeAlias = tuple[np.float32, ...]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PointMap:
    """An organized point cloud with color, on the depth image's grid.

    The arrays are made read-only, so that one map can be shared between threads without a copy.

    Parameters
    ----------
    points_m : (H, W, 3) float32
        Points in the depth camera's frame, meters; NaN in all three where there is no point.
    color : (H, W, 3) uint8
        RGB of each point, also where it was filled in.
    colored : (H, W) bool
        Where the color camera saw the point itself. False where the point is hidden from it, is so near
        to an outline that the hiding object's color mixes in, or is outside the color image; there
        `color` comes from the nearest points that are not in front of it.
    known_rays : Rays, optional
        Of the depth camera, where its calibration is known.

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
    known_rays: Rays | None = None
    valid: NDArray[np.bool_] = field(init=False)

    def __repr__(self) -> str:
        height, width = self.valid.shape
        return f"PointMap({width}x{height}, {np.count_nonzero(self.valid)} points)"

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

    @property
    def rays(self) -> Rays:
        """Rays of the pixels, estimated from the points if the calibration is unknown."""
        return self.known_rays or rays_through(self.points_m, self.valid)


def register(frame: RGBDFrame) -> PointMap:
    """Give each depth pixel of one frame its point in space and its color.

    Of several frames a `Registration` prepares only once what depends on the calibration.

    Depth pixels are back-projected along their undistorted rays. Each point is transformed into the color
    camera's frame, projected through its lens, and compared with a z-buffer of all points; its color is
    sampled bilinearly. If depth and color are registered already, the color image is passed through.

    Parameters
    ----------
    frame : RGBDFrame
        Depth and color, which may differ in size, with the calibration of both cameras.

    Returns
    -------
    PointMap
        On the depth image's grid, in the depth camera's frame.
    """
    return Registration().register(frame)


class Registration:
    """Registers frames as `register` does, and prepares what depends on their calibration when it changes."""

    def __init__(self) -> None:
        self._prepared: _Prepared | None = None

    def register(self, frame: RGBDFrame) -> PointMap:
        """Return the points of a frame; see `register`."""
        # By value, as sources may make a new calibration for every frame.
        if self._prepared is None or not frame.calibration.equals(self._prepared.calibration):
            self._prepared = _Prepared(frame.calibration)
        return self._prepared.register(frame)


class _Prepared:
    """What registration needs of a calibration."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        self._registered = calibration.is_registered
        rays = calibration.depth.rays()
        on_rays = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=2)
        self._rays = rays_through(on_rays, np.isfinite(rays[..., 0]))
        self._ray_x, self._ray_y = np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
        if self._registered:
            return
        from nurbseg.common.lens import lens_terms  # late: most images are registered

        color = calibration.color
        coefficients, fold, tilt = lens_terms(color.distortion)
        self._lens = _numbers(coefficients), np.float32(fold**2), _numbers(tilt)
        self._camera = _numbers(np.array([color.fx, color.fy, color.cx, color.cy]))
        self._size = color.height, color.width
        self._color_from_depth = _numbers(calibration.color_from_depth[:3])
        # The z-buffer's cells are as large as a depth pixel: smaller ones would leave gaps.
        depth_focal = min(calibration.depth.fx, abs(calibration.depth.fy))
        color_focal = min(color.fx, abs(color.fy))
        self._cells_per_px = min(1.0, depth_focal / color_focal)
        self._cells = int(color.height * self._cells_per_px) + 1, int(color.width * self._cells_per_px) + 1
        baseline_m = float(np.linalg.norm(calibration.color_from_depth[:3, 3]))
        parallax_px_m = self._cells_per_px * color_focal * baseline_m
        self._occluding_per_m = _HIDING_PARALLAX_PX / parallax_px_m if parallax_px_m > 0 else np.inf

    def register(self, frame: RGBDFrame) -> PointMap:
        depth_mm = np.ascontiguousarray(frame.depth_mm)
        points = _back_projected(depth_mm, self._ray_x, self._ray_y)
        if self._registered:
            return PointMap(points, frame.color, np.isfinite(points[..., 2]), self._rays)
        u, v, nearness, cell, buffer = _projected(
            *(depth_mm, self._ray_x, self._ray_y, self._color_from_depth, *self._lens, self._camera),
            *(*self._size, np.float32(self._cells_per_px), *self._cells),
        )
        if np.isfinite(self._occluding_per_m):
            # Closing fills the gaps of a surface that the color camera sees stretched. Dilation, as sampling
            # between pixels mixes in the color of what is in front in the next cell.
            image, around = buffer[1:].reshape(self._cells), np.ones((3, 3), np.uint8)
            closed = cv2.morphologyEx(image, cv2.MORPH_CLOSE, around)
            cv2.dilate(closed, around, dst=image)
        color = np.asarray(cv2.remap(frame.color, u, v, cv2.INTER_LINEAR), dtype=np.uint8)
        colored, missing = _seen(points, nearness, cell, buffer, np.float32(self._occluding_per_m), color)
        from nurbseg.segmentation.points.color_fill import fill_colors  # late, as above

        fill_colors(color, colored, missing, points[..., 2], min(self._occluding_per_m, 0.05))
        return PointMap(points, color, colored, self._rays)


def _numbers(values: NDArray[np.float64]) -> Numbers:
    return tuple(values.astype(np.float32).ravel())


@compiled
def _back_projected(depth_mm: U16, ray_x: F32, ray_y: F32) -> F32:
    """Points on their rays, (H, W, 3); NaN where there is no depth or no ray."""
    height, width = depth_mm.shape
    points_m = np.empty((height, width, 3), dtype=np.float32)
    for row in range(height):
        for column in range(width):
            x, y = ray_x[row, column], ray_y[row, column]
            known = depth_mm[row, column] != 0 and not np.isnan(x)
            z = np.float32(depth_mm[row, column]) * _METRES_PER_MM if known else np.float32(np.nan)
            points_m[row, column, 0] = x * z
            points_m[row, column, 1] = y * z
            points_m[row, column, 2] = z
    return points_m


@compiled
def _projected(
    depth_mm: U16,
    ray_x: F32,
    ray_y: F32,
    color_from_depth: Numbers,
    lens: Numbers,
    fold_square: np.float32,
    tilt: Numbers,
    camera: Numbers,
    color_height: int,
    color_width: int,
    cells_per_px: np.float32,
    cells_high: int,
    cells_wide: int,
) -> tuple[F32, F32, F32, I32, F32]:
    """Project the point of every pixel into the color image.

    Returns its position there, limited to the image, pixels; its inverse depth in the color camera's frame,
    1/m, and its cell of the z-buffer, from 1, both 0 where the point is outside the image; and the z-buffer.
    """
    height, width = shape = depth_mm.shape
    u, v = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    nearness, cell = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.int32)
    buffer = np.zeros(1 + cells_high * cells_wide, dtype=np.float32)
    fx, fy, cx, cy = camera
    zero, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    right, bottom, wide = np.float32(color_width - 1), np.float32(color_height - 1), np.int32(cells_wide)
    t00, t01, t02, t03, t10, t11, t12, t13, t20, t21, t22, t23 = color_from_depth
    for row in range(height):
        depths, rays_x, rays_y = depth_mm[row], ray_x[row], ray_y[row]
        row_u, row_v, row_nearness, row_cell = u[row], v[row], nearness[row], cell[row]
        # Without branches, so that the loop is vectorized.
        for n in range(width):
            z = np.float32(depths[n]) * _METRES_PER_MM
            x, y = rays_x[n] * z, rays_y[n] * z
            depth = t20 * x + t21 * y + t22 * z + t23
            # Also False where there is no ray, which is NaN.
            known = (depth > _NEAREST_M) & (depths[n] != 0)
            near = one / depth if known else zero
            at_x, at_y = (
                (t00 * x + t01 * y + t02 * z + t03) * near,
                (t10 * x + t11 * y + t12 * z + t13) * near,
            )
            at_x, at_y = _limited(at_x, -_FAR_ASIDE, _FAR_ASIDE), _limited(at_y, -_FAR_ASIDE, _FAR_ASIDE)
            at_x, at_y = _distorted(at_x, at_y, lens, fold_square, tilt)
            at_u, at_v = at_x * fx + cx, at_y * fy + cy
            # Pixel centers are at integers, so the image begins at -1/2.
            inside = (at_u >= -half) & (at_u < right + half) & (at_v >= -half) & (at_v < bottom + half)
            row_u[n], row_v[n] = _limited(at_u, zero, right), _limited(at_v, zero, bottom)
            near = near if inside else zero
            number = wide * np.int32((at_v + half) * cells_per_px)
            number += np.int32((at_u + half) * cells_per_px) + 1
            row_nearness[n], row_cell[n] = near, number if near > zero else 0
        for n in range(width):
            number = row_cell[n]
            buffer[number] = max(buffer[number], row_nearness[n])
    return u, v, nearness, cell, buffer


@inlined
def _limited(x: np.float32, least: np.float32, most: np.float32) -> np.float32:
    x = x if x > least else least
    return x if x < most else most


@inlined
def _distorted(
    x: np.float32, y: np.float32, lens: Numbers, fold_square: np.float32, tilt: Numbers
) -> tuple[np.float32, np.float32]:
    """Distort image coordinates by OpenCV's model; coefficients of 0 and a tilt of none change nothing."""
    one, two = np.float32(1.0), np.float32(2.0)
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, _, _ = lens
    a, b, c, d, e, f, g, h, i = tilt
    r2 = x * x + y * y
    radial = (one + r2 * (k1 + r2 * (k2 + r2 * k3))) / (one + r2 * (k4 + r2 * (k5 + r2 * k6)))
    # Beyond the fold the model would bring points back into the image.
    radial = _FAR_ASIDE if r2 > fold_square else radial
    radial += two * (p1 * y + p2 * x)
    x, y = x * radial + r2 * (p2 + s1 + r2 * s2), y * radial + r2 * (p1 + s3 + r2 * s4)
    w = g * x + h * y + i
    return (a * x + b * y + c) / w, (d * x + e * y + f) / w


@compiled
def _seen(
    points_m: F32, nearness: F32, cell: I32, buffer: F32, hiding_per_m: np.float32, color: U8
) -> tuple[Bool, Bool]:
    """Return which points the color camera sees, and which it does not; blacken pixels without a point."""
    height, width = cell.shape
    seen, missing = np.empty((height, width), dtype=np.bool_), np.empty((height, width), dtype=np.bool_)
    for row in range(height):
        for column in range(width):
            number = cell[row, column]
            valid = not np.isnan(points_m[row, column, 2])
            seen[row, column] = number > 0 and buffer[number] - nearness[row, column] <= hiding_per_m
            missing[row, column] = valid and not seen[row, column]
            if not valid:
                color[row, column, 0] = color[row, column, 1] = color[row, column, 2] = 0
    return seen, missing
