"""Calibration files of OpenCV (XML and YAML) and of PCL's image grabber (XML)."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel, camera_of_matrix, image_size, number
from nurbseg.drivers.errors import CalibrationError, quoted
from nurbseg.drivers.frame import Calibration
from nurbseg.drivers.structured_text import parse_xml, parse_yaml, scalar

# Names under which programs keep a stereo calibration: matrix, distortion, width, height. The first of a
# numbered pair is the depth camera, so that R and T take its points to the color camera.
_DEPTH_NAMES = (
    ("depth_camera_matrix", "depth_distortion", "depth_width", "depth_height"),
    ("IR_intrinsic_params", "IR_distortion_coefficients", "IR_width", "IR_height"),
    ("depth_intrinsics", "depth_distortion", "depth_width", "depth_height"),
    ("M1", "D1", "width1", "height1"),
    ("cameraMatrix1", "distCoeffs1", "width1", "height1"),
)
_COLOR_NAMES = (
    ("color_camera_matrix", "color_distortion", "color_width", "color_height"),
    ("RGB_intrinsic_params", "RGB_distortion_coefficients", "RGB_width", "RGB_height"),
    ("rgb_intrinsics", "rgb_distortion", "rgb_width", "rgb_height"),
    ("M2", "D2", "width2", "height2"),
    ("cameraMatrix2", "distCoeffs2", "width2", "height2"),
)
_SINGLE_NAMES = (("camera_matrix", "distortion_coefficients", "image_width", "image_height"),)
_ROTATION_NAMES = ("R", "Rotation")
_TRANSLATION_NAMES = ("T", "Translation")
#: The cameras of one sensor are closer than this; a longer translation is in millimetres.
_LONGEST_BASELINE_M = 1.0


def from_xml(path: Path, text: str) -> CameraFile:
    """Read OpenCV's XML or the XML that PCL's image grabber takes.

    Raises
    ------
    CalibrationError
        If it is neither, or a field is missing or unusable.
    """
    body = text.partition("?>")[2] if text.startswith("<?xml") else text
    storage = "<opencv_storage" in text
    try:
        # The grabber's files have two roots, <rgb> and <depth>, which XML does not allow.
        root = parse_xml(f"<cameras>{body}</cameras>")
    except ValueError as err:
        form = "a file of OpenCV" if storage else "valid XML"
        raise CalibrationError(f"{path}: not {form} ({err})") from err
    if not storage:
        return _from_grabber(path, root)
    return _from_storage(path, {node.tag: _storage_node(node) for node in root.iterfind("opencv_storage/*")})


def from_yaml(path: Path, text: str) -> CameraFile:
    """Read OpenCV's YAML of a stereo calibration or of one camera.

    Raises
    ------
    CalibrationError
        If it is neither, or a field is missing or unusable.
    """
    try:
        # OpenCV's first line, "%YAML:1.0", is not YAML's.
        storage = parse_yaml(text.partition("\n")[2])
    except ValueError as err:
        raise CalibrationError(f"{path}: not a file of OpenCV ({err})") from err
    if not isinstance(storage, dict):
        raise CalibrationError(f"{path}: not a file of OpenCV (expected named values, got {quoted(storage)})")
    return _from_storage(path, storage)


def _storage_node(node: Element) -> Any:
    """Return an element as YAML would give it: a matrix as a dict, its numbers as a list."""
    if len(node):
        return {child.tag: _storage_node(child) for child in node}
    words = (node.text or "").split()
    return [scalar(word) for word in words] if node.tag == "data" else scalar(" ".join(words))


def _from_storage(path: Path, storage: dict[str, Any]) -> CameraFile:
    single = _camera(path, storage, _SINGLE_NAMES)
    if single is not None:
        return CameraFile(path=path, depth=single, color=single)
    depth, color = _camera(path, storage, _DEPTH_NAMES), _camera(path, storage, _COLOR_NAMES)
    if depth is None or color is None:
        names = _DEPTH_NAMES if depth is None else _COLOR_NAMES
        raise CalibrationError(
            f"{path}: {names[0][0]}: missing; expected a matrix of that name or one of "
            f"{', '.join(name for name, *_ in names[1:])}, or camera_matrix for registered images"
        )
    transform = np.eye(4)
    transform[:3, :3] = _rotation(path, _named_matrix(path, storage, _ROTATION_NAMES))
    translation = _named_matrix(path, storage, _TRANSLATION_NAMES)
    if translation.size != 3:
        raise CalibrationError(f"{path}: T: expected 3 numbers, got {quoted(translation.tolist())}")
    in_millimetres = np.linalg.norm(translation) >= _LONGEST_BASELINE_M
    transform[:3, 3] = translation.ravel() * (0.001 if in_millimetres else 1.0)
    return CameraFile(path=path, depth=depth, color=color, color_from_depth=transform)


def _camera(
    path: Path, storage: dict[str, Any], names: tuple[tuple[str, str, str, str], ...]
) -> CameraModel | None:
    for matrix_name, distortion_name, width_name, height_name in names:
        matrix = _matrix(path, storage, matrix_name)
        if matrix is None:
            continue
        distortion = _matrix(path, storage, distortion_name)
        size: tuple[int, int] | None = None
        if width_name in storage and height_name in storage:
            size = image_size(path, (width_name, height_name), (storage[width_name], storage[height_name]))
        flat = None if distortion is None else distortion.ravel()
        return camera_of_matrix(path, matrix_name, matrix, flat, size)
    return None


def _matrix(path: Path, storage: dict[str, Any], name: str) -> NDArray[np.float64] | None:
    if name not in storage:
        return None
    node = storage[name]
    if not isinstance(node, dict) or not all(key in node for key in ("rows", "cols", "dt", "data")):
        raise CalibrationError(f"{path}: {name}: expected a matrix")
    rows, columns, data = node["rows"], node["cols"], node["data"]
    counts = all(isinstance(count, int) and count > 0 for count in (rows, columns))
    if not counts or not isinstance(data, list) or len(data) != rows * columns:
        raise CalibrationError(
            f"{path}: {name}: expected rows x cols numbers in data, got {quoted(rows)} x {quoted(columns)} "
            f"and {len(data) if isinstance(data, list) else quoted(data)}"
        )
    return np.array([number(path, name, value) for value in data]).reshape(rows, columns)


def _named_matrix(path: Path, storage: dict[str, Any], names: tuple[str, ...]) -> NDArray[np.float64]:
    for name in names:
        matrix = _matrix(path, storage, name)
        if matrix is not None:
            return matrix
    raise CalibrationError(f"{path}: {names[0]}: missing; expected a matrix {' or '.join(names)}")


def _rotation(path: Path, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    if matrix.size == 3:
        return np.asarray(cv2.Rodrigues(matrix.reshape(3))[0], dtype=np.float64)
    if matrix.shape != (3, 3):
        raise CalibrationError(f"{path}: R: expected a 3 x 3 matrix or 3 numbers, got {matrix.shape}")
    return matrix


def _from_grabber(path: Path, root: Element) -> CameraFile:
    def value(camera: str, key: str) -> float:
        text = root.findtext(f"{camera}/{key}")
        try:
            return number(path, f"{camera}/{key}", float(text or "missing"))
        except ValueError as err:
            if isinstance(err, CalibrationError):
                raise
            raise CalibrationError(f"{path}: {camera}/{key}: expected a number, got {quoted(text)}") from err

    def camera(name: str) -> CameraModel:
        return CameraModel(
            path=path,
            field=name,
            fx=value(name, "focal_length_x"),
            fy=value(name, "focal_length_y"),
            cx=value(name, "principal_point_x"),
            cy=value(name, "principal_point_y"),
        )

    color, depth = camera("rgb"), camera("depth")
    scale_m = value("depth", "z_multiplication_factor")
    if scale_m <= 0:
        raise CalibrationError(f"{path}: depth/z_multiplication_factor: expected more than 0, got {scale_m}")
    return CameraFile(path=path, depth=depth, color=color, depth_scale=1.0 / scale_m)


def write_opencv(path: Path, calibration: Calibration) -> None:
    """Write a stereo calibration for `cv2.FileStorage`; the translation is in metres."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if not storage.isOpened():
        raise OSError(f"{path}: cannot be written")
    cameras = ((_DEPTH_NAMES[0], calibration.depth), (_COLOR_NAMES[0], calibration.color))
    for (matrix, distortion, width, height), camera in cameras:
        storage.write(width, camera.width)
        storage.write(height, camera.height)
        storage.write(matrix, camera.matrix)
        if camera.distortion.size:
            storage.write(distortion, camera.distortion.reshape(1, -1))
    storage.write("R", np.ascontiguousarray(calibration.color_from_depth[:3, :3]))
    storage.write("T", np.ascontiguousarray(calibration.color_from_depth[:3, 3:]))
    storage.release()
