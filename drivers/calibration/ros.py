"""ROS's ``camera_info`` as YAML: the file of a camera driver, or a message printed by ``ros2 topic echo``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.calibration.cameras import CameraFile, camera_of_matrix, image_size, number
from nurbseg.drivers.errors import CalibrationError, quoted
from nurbseg.drivers.frame import Calibration
from nurbseg.drivers.structured_text import parse_yaml

#: ROS's names of OpenCV's distortion model; others, as "equidistant", are different models.
_DISTORTION_MODELS = ("plumb_bob", "rational_polynomial", "thin_prism_fisheye")
#: Names of the same thing in a driver's file, in a ROS 2 and in a ROS 1 message.
_MATRIX_NAMES = ("camera_matrix", "k", "K")
_DISTORTION_NAMES = ("distortion_coefficients", "d", "D")
_WIDTH_NAMES, _HEIGHT_NAMES = ("image_width", "width"), ("image_height", "height")


def from_yaml(path: Path, text: str) -> CameraFile:
    """Read a ``camera_info``, whose one camera stands for both images.

    Raises
    ------
    CalibrationError
        If it is not one, or a field is missing or unusable.
    """
    try:
        # A printed message may be followed by more, after "---".
        table = parse_yaml(text)
    except ValueError as err:
        raise CalibrationError(f"{path}: not valid YAML ({err})") from err
    if not isinstance(table, Mapping):
        raise CalibrationError(f"{path}: expected the fields of a camera_info, got {type(table).__name__}")
    name, values = _field(path, table, _MATRIX_NAMES)
    matrix = _numbers(path, name, values)
    if matrix.size != 9:
        raise CalibrationError(f"{path}: {name}: expected 9 numbers, got {matrix.size}")
    if not matrix.any():
        raise CalibrationError(f"{path}: {name}: the camera is not calibrated (all zeros)")
    model = table.get("distortion_model") or _DISTORTION_MODELS[0]
    if model not in _DISTORTION_MODELS:
        expected = ", ".join(_DISTORTION_MODELS)
        raise CalibrationError(f"{path}: distortion_model: expected one of {expected}, got {quoted(model)}")
    distortion = np.zeros(0)
    if any(each in table for each in _DISTORTION_NAMES):
        distortion = _numbers(path, *_field(path, table, _DISTORTION_NAMES))
    sizes = [_field(path, table, names) for names in (_WIDTH_NAMES, _HEIGHT_NAMES)]
    size = image_size(path, (sizes[0][0], sizes[1][0]), (sizes[0][1], sizes[1][1]))
    camera = camera_of_matrix(path, name, matrix.reshape(3, 3), distortion, size)
    return CameraFile(path=path, depth=camera, color=camera)


def to_yaml(calibration: Calibration) -> str:
    """Return the ``camera_info`` of registered images.

    Raises
    ------
    ValueError
        If depth and color have cameras of their own, which one ``camera_info`` cannot say.
    """
    if not calibration.is_registered:
        raise ValueError("camera_info holds one camera; depth and color have one each: write TOML or OpenCV")
    camera = calibration.color
    distortion = [float(value) for value in camera.distortion] or [0.0] * 5
    model = "plumb_bob" if len(distortion) <= 5 else "rational_polynomial"
    projection = np.hstack([camera.matrix, np.zeros((3, 1))])
    matrices = (
        ("camera_matrix", 3, 3, camera.matrix.ravel().tolist()),
        ("distortion_coefficients", 1, len(distortion), distortion),
        ("rectification_matrix", 3, 3, np.eye(3).ravel().tolist()),
        ("projection_matrix", 3, 4, projection.ravel().tolist()),
    )
    lines = [
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
        "camera_name: rgbd",
        f"distortion_model: {model}",
    ]
    for name, rows, columns, values in matrices:
        lines += [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {values}"]
    return "\n".join(lines) + "\n"


def _field(path: Path, table: Mapping[str, Any], names: tuple[str, ...]) -> tuple[str, Any]:
    name = next((each for each in names if each in table), None)
    if name is None:
        others = f" or {', '.join(names[1:])}" if len(names) > 1 else ""
        raise CalibrationError(f"{path}: {names[0]}: missing; expected {names[0]}{others}")
    return name, table[name]


def _numbers(path: Path, name: str, values: Any) -> NDArray[np.float64]:
    """Return the numbers of a list, or of a matrix with rows, cols and data."""
    if isinstance(values, Mapping):
        rows, columns, values = values.get("rows"), values.get("cols"), values.get("data")
        if (
            not isinstance(rows, int)
            or not isinstance(columns, int)
            or not isinstance(values, list)
            or len(values) != rows * columns
        ):
            raise CalibrationError(f"{path}: {name}: expected rows, cols and as many numbers in data")
    if not isinstance(values, list):
        raise CalibrationError(f"{path}: {name}: expected a list of numbers, got {quoted(values)}")
    return np.array([number(path, name, value) for value in values], dtype=np.float64)
