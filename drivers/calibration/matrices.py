"""Calibrations as named matrices: OpenCV's XML and YAML, and ROS's ``camera_info`` as YAML.

A ``camera_info`` is the file of a camera driver, or a message printed by ``ros2 topic echo``.
"""

import math
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel, image_size, number
from nurbseg.drivers.errors import CalibrationError, quoted
from nurbseg.drivers.structured_text import parse_xml, parse_yaml, scalar

#: Names of a camera's matrix, distortion, width and height where it stands for both images, ...
_SINGLE_NAMES = (
    ("camera_matrix", "k", "K"),
    ("distortion_coefficients", "d", "D"),
    ("image_width", "width"),
    ("image_height", "height"),
)
#: ... and in a stereo calibration, with the words for the depth and the color camera. The first of a numbered
#: pair is the depth camera, so that R and T take its points to the color camera.
_STEREO_NAMES = (
    ("{}_camera_matrix", "{}_distortion", "{}_width", "{}_height", ("depth", "color")),
    ("{}_intrinsic_params", "{}_distortion_coefficients", "{}_width", "{}_height", ("IR", "RGB")),
    ("{}_intrinsics", "{}_distortion", "{}_width", "{}_height", ("depth", "rgb")),
    ("M{}", "D{}", "width{}", "height{}", ("1", "2")),
    ("cameraMatrix{}", "distCoeffs{}", "width{}", "height{}", ("1", "2")),
)
#: ROS's names of OpenCV's distortion model; others, as "equidistant", are different models.
_DISTORTION_MODELS = ("plumb_bob", "rational_polynomial", "thin_prism_fisheye")
#: The cameras of one sensor are closer than this; a longer translation is in millimetres.
_LONGEST_BASELINE_M = 1.0


def from_xml(path: Path, text: str) -> CameraFile:
    """Read OpenCV's XML; raises CalibrationError if it is not that, or a field is missing or unusable."""
    try:
        root = parse_xml(text)
    except ValueError as err:
        raise CalibrationError(f"{path}: not valid XML ({err})") from err
    if root.tag != "opencv_storage":
        raise CalibrationError(f"{path}: expected OpenCV's <opencv_storage>, got {quoted(root.tag)}")
    # As YAML would give it: a matrix as a dict, its numbers as a list.
    table = {
        node.tag: {child.tag: _value(child) for child in node} if len(node) else _value(node) for node in root
    }
    return _cameras(path, table)


def from_yaml(path: Path, text: str) -> CameraFile:
    """Read OpenCV's YAML or a ``camera_info``.

    Raises CalibrationError if it is neither, or a field is missing or unusable.
    """
    # OpenCV's first line, "%YAML:1.0", is not YAML's. A printed message may be followed by more, after "---".
    head, _, rest = text.partition("\n")
    try:
        table = parse_yaml(rest if head.startswith("%YAML:") else text)
    except ValueError as err:
        raise CalibrationError(f"{path}: not valid YAML ({err})") from err
    if not isinstance(table, dict):
        raise CalibrationError(f"{path}: expected named matrices, got {quoted(table)}")
    return _cameras(path, table)


def _value(node: Element) -> Any:
    words = (node.text or "").split()
    return [scalar(word) for word in words] if node.tag == "data" else scalar(" ".join(words))


def _cameras(path: Path, table: dict[str, Any]) -> CameraFile:
    if any(name in table for name in _SINGLE_NAMES[0]):
        camera = _camera(path, table, _SINGLE_NAMES)
        return CameraFile(path=path, depth=camera, color=camera)
    for *forms, words in _STEREO_NAMES:
        names = [tuple((str(form).format(word),) for form in forms) for word in words]
        if names[0][0][0] in table:
            depth, color = (_camera(path, table, each) for each in names)
            return CameraFile(path=path, depth=depth, color=color, color_from_depth=_transform(path, table))
    stereo = " or ".join(str(form).format(words[0]) for form, *_, words in _STEREO_NAMES)
    raise CalibrationError(
        f"{path}: camera_matrix: missing; expected camera_matrix, k or K for registered images, else {stereo}"
    )


def _camera(path: Path, table: dict[str, Any], names: tuple[tuple[str, ...], ...]) -> CameraModel:
    name, matrix = _matrix(path, table, names[0])
    if matrix.size != 9:
        raise CalibrationError(f"{path}: {name}: expected 9 numbers, got {matrix.size}")
    check_distortion_model(path, "distortion_model", table.get("distortion_model"))
    distortion = np.zeros(0)
    if any(each in table for each in names[1]):
        distortion = _matrix(path, table, names[1])[1].ravel()
    width, height = (next((each for each in alike if each in table), alike[0]) for alike in names[2:])
    size = None
    if width in table or height in table:
        size = image_size(path, (width, height), (table.get(width), table.get(height)))
    return CameraModel(path, name, matrix.reshape(3, 3), distortion, size)


def check_distortion_model(path: Path, field: str, model: Any) -> None:
    """Raise CalibrationError if a lens model is named that is not OpenCV's."""
    if model and model not in _DISTORTION_MODELS:
        expected = ", ".join(_DISTORTION_MODELS)
        raise CalibrationError(f"{path}: {field}: expected one of {expected}, got {quoted(model)}")


def _transform(path: Path, table: dict[str, Any]) -> NDArray[np.float64]:
    _, rotation = _matrix(path, table, ("R", "Rotation"))
    if rotation.size == 3:
        rotation = np.asarray(cv2.Rodrigues(rotation.reshape(3))[0], dtype=np.float64)
    if rotation.size != 9:
        raise CalibrationError(f"{path}: R: expected a 3 x 3 matrix or 3 numbers, got {rotation.shape}")
    _, translation = _matrix(path, table, ("T", "Translation"))
    if translation.size != 3:
        raise CalibrationError(f"{path}: T: expected 3 numbers, got {quoted(translation.tolist())}")
    in_millimetres = np.linalg.norm(translation) >= _LONGEST_BASELINE_M
    transform = np.eye(4)
    transform[:3, :3] = rotation.reshape(3, 3)
    transform[:3, 3] = translation.ravel() * (0.001 if in_millimetres else 1.0)
    return transform


def _matrix(path: Path, table: dict[str, Any], names: tuple[str, ...]) -> tuple[str, NDArray[np.float64]]:
    """Return the first of these names in the table, and its numbers: a list, (N,), or rows, cols and data."""
    name = next((each for each in names if each in table), None)
    if name is None:
        raise CalibrationError(f"{path}: {names[0]}: missing; expected a matrix {' or '.join(names)}")
    values: Any = table[name]
    shape: list[Any] = [-1]
    if isinstance(values, dict):
        shape, values = [values.get("rows"), values.get("cols")], values.get("data")
        counts = all(isinstance(count, int) and count > 0 for count in shape)
        if not counts or not isinstance(values, list) or len(values) != math.prod(shape):
            raise CalibrationError(
                f"{path}: {name}: expected rows x cols numbers in data, got {quoted(shape[0])} x "
                f"{quoted(shape[1])} and {len(values) if isinstance(values, list) else quoted(values)}"
            )
    if not isinstance(values, list):
        raise CalibrationError(
            f"{path}: {name}: expected a matrix or a list of numbers, got {quoted(values)}"
        )
    numbers = [number(path, name, value) for value in values]
    return name, np.array(numbers, dtype=np.float64).reshape(shape)
