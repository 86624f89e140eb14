"""The factory calibration of an Azure Kinect, as its recordings hold it, for the mode that was recorded.

It is that of the whole sensors, in parts of their size and with pixel corners at whole numbers [1]_.

References
----------
.. [1] Microsoft, Azure Kinect Sensor SDK, ``src/transformation/mode_specific_calibration.c``.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, quoted
from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel, number

#: By the size of depth images: that of the sensor, perhaps binned, and where they begin on it, pixels.
_DEPTH_MODES = {
    (320, 288): (512, (96, 90)),
    (640, 576): (1024, (192, 180)),
    (512, 512): (512, (0, 0)),
    (1024, 1024): (1024, (0, 0)),
}
_MODEL = "CALIBRATION_LensDistortionModel"
#: Its parameters: the principal point, focal lengths, radial coefficients, a center and tangential ones.
_PARAMETERS = 14


def cameras_of_kinect(
    path: Path, table: Any, depth_size: tuple[int, int], color_size: tuple[int, int] | None
) -> CameraFile:
    """Return the cameras for images of these sizes; without color, the depth camera stands for both.

    Raises CalibrationError if the table lacks a camera, or holds a value that is unusable.
    """
    try:
        cameras = {camera["Location"].rpartition("Location")[2]: camera for camera in _cameras(table)}
        depth_camera = cameras["D0"]
        color_camera = None if color_size is None else cameras["PV0"]
    except (AttributeError, KeyError, TypeError) as err:
        raise CalibrationError(f"{path}: Cameras: expected those at D0 and PV0 ({quoted(str(err))})") from err
    if depth_size not in _DEPTH_MODES:
        raise CalibrationError(f"{path}: depth: {depth_size[0]}x{depth_size[1]} is no mode of the camera")
    side, begin = _DEPTH_MODES[depth_size]
    depth = _camera(path, "D0", depth_camera, (side, side), begin, depth_size)
    if color_camera is None or color_size is None:
        return CameraFile(path=path, depth=depth, color=depth)
    sensor = [number(path, f"PV0.{key}", color_camera.get(key)) for key in ("SensorWidth", "SensorHeight")]
    if min(sensor) < 1:
        raise CalibrationError(f"{path}: PV0.SensorWidth: expected pixels, got {quoted(sensor)}")
    # Images have all columns, and rows around the middle.
    full = color_size[0], color_size[0] * sensor[1] / sensor[0]
    color = _camera(path, "PV0", color_camera, full, (0, (full[1] - color_size[1]) / 2), color_size)
    color_from_depth = _pose(path, "PV0", color_camera) @ np.linalg.inv(_pose(path, "D0", depth_camera))
    return CameraFile(path=path, depth=depth, color=color, color_from_depth=color_from_depth)


def depth_from_accelerometer(path: Path, table: Any) -> NDArray[np.float64] | None:
    """Return the turn (3, 3) from the accelerometer's axes to the depth camera's; None if not stated."""
    try:
        sensors = table["CalibrationInformation"]["InertialSensors"]
        (own,) = (sensor for sensor in sensors if str(sensor["SensorType"]).endswith("Accelerometer"))
        (depth,) = (camera for camera in _cameras(table) if str(camera["Location"]).endswith("D0"))
        turns = [_pose(path, "pose", each)[:3, :3] for each in (depth, own)]
    except (CalibrationError, KeyError, TypeError, ValueError):
        return None
    return np.asarray(turns[0] @ turns[1].T)


def _cameras(table: Any) -> list[Any]:
    cameras = table["CalibrationInformation"]["Cameras"]
    return cameras if isinstance(cameras, list) else []


def _camera(
    path: Path,
    name: str,
    table: dict[str, Any],
    full: tuple[float, float],
    begin: tuple[float, float],
    size: tuple[int, int],
) -> CameraModel:
    """Return a camera of images that begin at a place of the sensor, whose whole image has a `full` size."""
    lens = table.get("Intrinsics")
    values = lens.get("ModelParameters") if isinstance(lens, dict) else None
    field = f"{name}.ModelParameters"
    if not isinstance(lens, dict) or not isinstance(values, list) or len(values) != _PARAMETERS:
        raise CalibrationError(f"{path}: {field}: expected {_PARAMETERS} numbers, got {quoted(values)}")
    numbers = [number(path, field, value) for value in values]
    cx, cy, fx, fy, *radial = numbers[:10]
    center, (p2, p1) = numbers[10:12], numbers[12:]
    model = str(lens.get("ModelType")).removeprefix(_MODEL)
    if model not in ("BrownConrady", "Rational6KT") or any(center):
        raise CalibrationError(f"{path}: {name}.ModelType: {quoted(model)} is not OpenCV's model")
    # Of this model, the terms with x y lack OpenCV's factor of 2, and those with squares do not.
    if model == "Rational6KT" and (p1 or p2):
        raise CalibrationError(f"{path}: {name}.ModelType: Rational6KT with tangential terms is not OpenCV's")
    matrix = np.eye(3)
    matrix[0] = fx * full[0], 0, cx * full[0] - begin[0] - 0.5
    matrix[1] = 0, fy * full[1], cy * full[1] - begin[1] - 0.5
    return CameraModel(path, field, matrix, np.array([*radial[:2], p1, p2, *radial[2:]]), size)


def _pose(path: Path, name: str, table: dict[str, Any]) -> NDArray[np.float64]:
    """Return what takes points of the sensors' common frame to this camera's, meters."""
    pose, stated = np.eye(4), table.get("Rt")
    for key, part, count in (("Rotation", pose[:3, :3], 9), ("Translation", pose[:3, 3], 3)):
        values = stated.get(key) if isinstance(stated, dict) else None
        if not isinstance(values, list) or len(values) != count:
            raise CalibrationError(f"{path}: {name}.{key}: expected {count} numbers, got {quoted(values)}")
        part[:] = np.reshape([number(path, f"{name}.{key}", value) for value in values], part.shape)
    if abs(np.linalg.det(pose) - 1) > 0.1:
        raise CalibrationError(f"{path}: {name}.Rotation: expected a rotation, got {pose[:3, :3].tolist()}")
    return pose
