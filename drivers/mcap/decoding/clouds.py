"""Reads organized point clouds in ROS 2 messages: those with the rows and columns of a depth image."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError
from nurbseg.common.frame import Intrinsics
from nurbseg.common.limits import PIXELS_MAX
from nurbseg.drivers.datasets.pcd import POINTS_FOR_FIT, count_points, fit_camera, in_camera_axes
from nurbseg.drivers.datasets.pcd_file import COLORS, rgb_of

#: Type of a number by PointField's constants, INT8 to FLOAT64.
_NUMBERS = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), start=1))


def cloud_points(message: Any, name: str) -> NDArray[np.float32]:
    """Return the (H, W, 3) points of a PointCloud2, meters; NaN in all three where there is none.

    They are in the axes of `in_camera_axes`. Raises FrameFormatError, which calls the cloud `name`, if it is
    damaged or has no coordinates.
    """
    points = np.stack([_field(message, axis, name).astype(np.float32) for axis in "xyz"], axis=-1)
    points[~np.isfinite(points).all(axis=-1)] = np.nan
    return in_camera_axes(points)


def cloud_depth(message: Any, name: str) -> NDArray[np.float32]:
    """Return the (H, W) depth of a PointCloud2, meters; 0 where there is no point."""
    return np.nan_to_num(cloud_points(message, name)[..., 2], copy=False, nan=0.0)


def cloud_color(message: Any, name: str) -> NDArray[np.uint8] | None:
    """Return the (H, W, 3) RGB of a PointCloud2; None if it has no color."""
    names = dict.fromkeys(field.name for field in message.fields if field.name in COLORS)
    return rgb_of({each: _field(message, each, name) for each in names})


def cloud_camera(message: Any, name: str) -> Intrinsics:
    """Return the camera on whose pixels the points lie; raises CalibrationError as `fit_camera` does."""
    return fit_camera(cloud_points(message, name), name)


def tells_camera(message: Any) -> bool:
    """Whether a PointCloud2 is organized and has enough points to find its camera."""
    try:
        return count_points(cloud_points(message, "")) >= POINTS_FOR_FIT
    except FrameFormatError:
        return False


def _field(message: Any, field: str, name: str) -> NDArray[Any]:
    """Return the (H, W) numbers of a field."""
    own = next((each for each in message.fields if each.name == field), None)
    if own is None or own.datatype not in _NUMBERS:
        got = ", ".join(f"{field.name} of type {field.datatype}" for field in message.fields[:16])
        raise FrameFormatError(f"{name}: fields: expected numbers called {field}, got {got or 'none'}")
    number = np.dtype(_NUMBERS[own.datatype]).newbyteorder(">" if message.is_bigendian else "<")
    height, width = message.height, message.width
    if not 0 < height * width <= PIXELS_MAX:
        raise FrameFormatError(
            f"{name}: height, width: expected 1 to {PIXELS_MAX} points, got {height * width}"
        )
    if own.offset + number.itemsize > message.point_step or width * message.point_step > message.row_step:
        raise FrameFormatError(
            f"{name}: point_step, row_step: {field} at byte {own.offset} does not fit into points of "
            f"{message.point_step} bytes, or {width} of these into rows of {message.row_step}"
        )
    size = (height - 1) * message.row_step + width * message.point_step
    if len(message.data) < size:
        raise FrameFormatError(f"{name}: data: the cloud is cut off: {len(message.data)} bytes of {size}")
    strides = (message.row_step, message.point_step)
    numbers = np.ndarray((height, width), number, message.data, own.offset, strides)
    return numbers.astype(number.newbyteorder("="))
