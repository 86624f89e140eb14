"""Reads and writes files that hold a sensor's calibration.

It reads our TOML, OpenCV's XML or YAML, ROS's ``camera_info`` YAML, and text: a matrix of 3 x 3 or 4 x 4, or
``fx fy cx cy``. A ``camera_info`` is the file of a camera driver, or a message printed by ``ros2 topic
echo``. It writes TOML.
"""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, quoted
from nurbseg.common.files import read_file, write_atomically
from nurbseg.common.frame import Calibration
from nurbseg.common.limits import TEXT_BYTES_MAX
from nurbseg.common.structured_text import (
    decode_text,
    parse_toml,
    parse_xml,
    parse_yaml,
    scalar,
)
from nurbseg.drivers.calibration.cameras import (
    DISTORTIONS,
    CameraFile,
    CameraModel,
    calibration_table,
    check_distortion_model,
    image_size,
    is_distortion,
    number,
    pinhole_matrix,
)
from nurbseg.drivers.calibration.foreign import stand_in
from nurbseg.drivers.depth_unit import DepthUnit

_CAMERA_KEYS = {"width", "height", "fx", "fy", "cx", "cy", "distortion"}
_FILE_KEYS = {"registered", "depth_scale", "color_from_depth", "depth", "color"}
#: Names of a camera's matrix, distortion, width and height where it stands for both images, ...
_SINGLE_NAMES = (
    ("camera_matrix", "k", "K", "cameraMatrix", "Camera_Matrix"),
    DISTORTIONS,
    ("image_width", "width", "image_Width"),
    ("image_height", "height", "image_Height"),
)
#: ... and in a stereo calibration, with the words for the depth and the color camera, and the unit of the
#: translation, meters. The first of a numbered pair is the depth camera, so that R and T take its points to
#: the color camera.
_STEREO_NAMES = (
    ("{}_camera_matrix", "{}_distortion", "{}_width", "{}_height", ("depth", "color"), 1.0),
    # As CAPE's data have it, whose lengths are millimeters.
    ("{}_intrinsic_params", "{}_distortion_coefficients", "{}_width", "{}_height", ("IR", "RGB"), 0.001),
    ("{}_intrinsics", "{}_distortion", "{}_width", "{}_height", ("depth", "rgb"), 1.0),
    ("M{}", "D{}", "width{}", "height{}", ("1", "2"), 1.0),
    ("cameraMatrix{}", "distCoeffs{}", "width{}", "height{}", ("1", "2"), 1.0),
)
_ADVICE = (
    "; of another program, give its fx, fy, cx, cy in pixels as --intrinsics fx,fy,cx,cy, or copy it to "
    "camera.toml (docs/calibration.md)"
)
_TEXT = "camera matrix: expected 3 rows of 3 numbers, 4 rows of 4, or fx fy cx cy"
_COMMENTS = ("#", "//", "%", ";")


def read_camera_file(path: Path) -> CameraFile:
    """Read what a calibration file says of the cameras and the depth's unit; image sizes may stay open.

    Raises CalibrationError if the file is missing, of an unknown form, lacks a field or holds an unusable
    value; the message names the file and the field.
    """
    content = read_file(path, TEXT_BYTES_MAX, what="calibration", error=CalibrationError)
    if (kind := stand_in(content)) is not None:
        raise CalibrationError(f"{path}: {kind}")
    try:
        text = decode_text(content)
    except UnicodeDecodeError as err:
        raise CalibrationError(f"{path}: expected text, got bytes that are not UTF-8") from err
    head, suffix = text.lstrip("\ufeff \t\r\n"), path.suffix.lower()
    if suffix == ".toml":
        return cameras_of_table(path, _parsed(path, "TOML", parse_toml, text))
    if head.startswith("<"):
        return _cameras(path, _table_of(path, _parsed(path, "XML", parse_xml, head)))
    if head.startswith("%YAML") or suffix in (".yaml", ".yml"):
        # OpenCV's first line, "%YAML:1.0", is not YAML's, and OpenCV needs no space after a colon. A printed
        # message may be followed by more, after "---".
        if head.startswith("%YAML:"):
            head = re.sub(r"^(\s*[\w.]+):(?=[^\s:])", r"\1: ", head.partition("\n")[2], flags=re.MULTILINE)
        return _cameras(path, _parsed(path, "YAML", parse_yaml, head))
    camera = CameraModel(path, "camera matrix", _matrix_of_text(path, text))
    return CameraFile(path=path, depth=camera, color=camera)


def _matrix_of_text(path: Path, text: str) -> NDArray[np.float64]:
    """Return the (3, 3) camera matrix in a text: the numbers of its rows, or fx fy cx cy."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith(_COMMENTS)]
    try:
        numbers = np.array(re.sub(r"[\[\],;]", " ", " ".join(lines)).split(), dtype=np.float64)
    except ValueError as err:
        raise CalibrationError(f"{path}: {_TEXT} ({quoted(str(err))}){_ADVICE}") from err
    if numbers.size == 4:
        return pinhole_matrix(*numbers.tolist())
    if numbers.size not in (9, 16):
        raise CalibrationError(f"{path}: {_TEXT}, got {numbers.size} numbers{_ADVICE}")
    side = math.isqrt(numbers.size)
    matrix = numbers.reshape(side, side)
    if side == 4 and (matrix[3].tolist() != [0, 0, 0, 1] or matrix[:3, 3].any()):
        raise CalibrationError(f"{path}: camera matrix: expected a last row 0 0 0 1 and column of 0 and 1")
    return matrix[:3, :3]


def _parsed(path: Path, form: str, parse: Callable[[str], Any], text: str) -> Any:
    try:
        return parse(text)
    except ValueError as err:
        raise CalibrationError(f"{path}: not valid {form} ({err})") from err


def write_calibration(path: Path, calibration: Calibration, depth_scale: int | None = None) -> None:
    """Write a calibration as TOML, and the depth units per meter of the images beside it, if it has any.

    Raises OSError if the file cannot be written.
    """
    registered = calibration.is_registered
    table = calibration_table(calibration)
    lines = [
        "# Calibration of an RGB-D sensor: focal lengths and principal points in pixels, lengths in meters,",
        "# distortion as OpenCV orders it (k1, k2, p1, p2, k3, ...).",
        f"registered = {str(registered).lower()}  # whether depth is registered to color already",
    ]
    if depth_scale is not None:
        lines.append(f"depth_scale = {depth_scale}  # depth units per meter")
    if not registered:
        rows = [f"  {row}," for row in table["color_from_depth"]]
        lines += ["# p_color = color_from_depth @ p_depth", "color_from_depth = [", *rows, "]"]
    for name in ("color",) if registered else ("color", "depth"):
        lines += ["", f"[{name}]", *(f"{key} = {value}" for key, value in table[name].items())]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def cameras_of_table(path: Path, table: Any) -> CameraFile:
    """Return the cameras of a table as in `calibration_table`; raises CalibrationError if it is not one."""
    _check_keys(path, "", table, _FILE_KEYS)
    registered = table.get("registered", False)
    if not isinstance(registered, bool):
        raise CalibrationError(f"{path}: registered: expected true or false, got {quoted(registered)}")
    unit = None
    if (scale := table.get("depth_scale")) is not None:
        if number(path, "depth_scale", scale) <= 0:
            raise CalibrationError(
                f"{path}: depth_scale: expected units per meter over 0, got {quoted(scale)}"
            )
        unit = DepthUnit(scale, f"{path.name}: depth_scale")
    cameras = {name: _toml_camera(path, name, table[name]) for name in ("depth", "color") if name in table}
    rows = table.get("color_from_depth")
    if not cameras:
        raise CalibrationError(f"{path}: color: the table is missing; expected [color] with fx, fy, cx, cy")
    if registered:
        if rows is not None:
            raise CalibrationError(f"{path}: color_from_depth: registered images have none; remove one")
        # The registered depth image has the color camera's geometry, whichever camera took it.
        camera = cameras.get("color") or cameras["depth"]
        return CameraFile(path=path, depth=camera, color=camera, depth_unit=unit)
    if missing := {"depth", "color"} - cameras.keys():
        missed = f"{missing.pop()}: the table is missing"
        raise CalibrationError(f"{path}: {missed}; one camera needs registered = true")
    if rows is None:
        raise CalibrationError(
            f"{path}: color_from_depth: missing; expected 4 rows of 4 numbers (meters), or registered = true"
        )
    if not isinstance(rows, list) or [isinstance(row, list) and len(row) for row in rows] != [4] * 4:
        raise CalibrationError(f"{path}: color_from_depth: expected 4 rows of 4 numbers, got {quoted(rows)}")
    matrix = np.array([[number(path, "color_from_depth", value) for value in row] for row in rows])
    return CameraFile(path=path, **cameras, color_from_depth=matrix, depth_unit=unit)


def _toml_camera(path: Path, name: str, table: Any) -> CameraModel:
    _check_keys(path, f"{name}.", table, _CAMERA_KEYS)
    for key in ("fx", "fy", "cx", "cy"):
        if key not in table:
            raise CalibrationError(f"{path}: {name}.{key}: missing; expected pixels")
    fx, fy, cx, cy = (number(path, f"{name}.{key}", table[key]) for key in ("fx", "fy", "cx", "cy"))
    size = image_size(path, (f"{name}.width", f"{name}.height"), (table.get("width"), table.get("height")))
    distortion = table.get("distortion", [])
    if not isinstance(distortion, list):
        raise CalibrationError(f"{path}: {name}.distortion: expected a list, got {quoted(distortion)}")
    coefficients = np.array([number(path, f"{name}.distortion", value) for value in distortion])
    return CameraModel(path, name, pinhole_matrix(fx, fy, cx, cy), coefficients, size)


def _check_keys(path: Path, prefix: str, table: Any, known: set[str]) -> None:
    if not isinstance(table, dict):
        name = prefix.rstrip(".") or "calibration"
        raise CalibrationError(f"{path}: {name}: expected a table [{name}], got {quoted(table)}")
    for key in table:
        if key not in known:
            expected = ", ".join(sorted(known))
            raise CalibrationError(
                f"{path}: {prefix}{quoted(key)[1:-1]}: unknown; expected one of {expected}"
            )


def _table_of(path: Path, root: Element) -> dict[str, Any]:
    """Return OpenCV's XML as YAML would give it: a matrix as a dict, its numbers as a list."""
    if root.tag != "opencv_storage":
        raise CalibrationError(f"{path}: expected OpenCV's <opencv_storage>, got {quoted(root.tag)}")
    return {
        node.tag: {child.tag: _value(child) for child in node} if len(node) else _value(node) for node in root
    }


def _value(node: Element) -> Any:
    words = (node.text or "").split()
    return [scalar(word) for word in words] if node.tag == "data" else scalar(" ".join(words))


def _cameras(path: Path, table: Any) -> CameraFile:
    if not isinstance(table, dict):
        raise CalibrationError(f"{path}: expected named matrices, got {quoted(table)}{_ADVICE}")
    if any(name in table for name in _SINGLE_NAMES[0]):
        for key in table:
            is_distortion(path, str(key))
        camera = _camera(path, table, _SINGLE_NAMES)
        return CameraFile(path=path, depth=camera, color=camera)
    for *forms, words, meters in _STEREO_NAMES:
        names = [tuple((str(form).format(word),) for form in forms) for word in words]
        if names[0][0][0] in table:
            for key in table.keys() - {name[0] for _, name, *_ in names}:
                is_distortion(path, str(key))
            depth, color = (_camera(path, table, name) for name in names)
            return CameraFile(
                path=path, depth=depth, color=color, color_from_depth=_transform(path, table, meters)
            )
    stereo = " or ".join(str(form).format(words[0]) for form, *_, words, _ in _STEREO_NAMES)
    single = "camera_matrix: missing; expected camera_matrix, k or K for registered images"
    raise CalibrationError(f"{path}: {single}, else {stereo}{_ADVICE}")


def _camera(path: Path, table: dict[str, Any], names: tuple[tuple[str, ...], ...]) -> CameraModel:
    name, matrix = _matrix(path, table, names[0])
    if matrix.size != 9:
        raise CalibrationError(f"{path}: {name}: expected 9 numbers, got {matrix.size}")
    distortion = np.zeros(0)
    if any(name in table for name in names[1]):
        distortion = _matrix(path, table, names[1])[1].ravel()
    # OpenCV's own program for calibration says so.
    model = "fisheye" if table.get("fisheye_model") else table.get("distortion_model")
    check_distortion_model(path, "distortion_model", model, distortion)
    width, height = (next((each for each in alike if each in table), alike[0]) for alike in names[2:])
    size = image_size(path, (width, height), (table.get(width), table.get(height)))
    return CameraModel(path, name, matrix.reshape(3, 3), distortion, size)


def _transform(path: Path, table: dict[str, Any], meters: float) -> NDArray[np.float64]:
    _, rotation = _matrix(path, table, ("R", "Rotation"))
    if rotation.size == 3:
        rotation = np.asarray(cv2.Rodrigues(rotation.reshape(3))[0], dtype=np.float64)
    if rotation.size != 9:
        raise CalibrationError(f"{path}: R: expected a 3 x 3 matrix or 3 numbers, got {rotation.shape}")
    _, translation = _matrix(path, table, ("T", "Translation"))
    if translation.size != 3:
        raise CalibrationError(f"{path}: T: expected 3 numbers, got {quoted(translation.tolist())}")
    transform = np.eye(4)
    transform[:3, :3] = rotation.reshape(3, 3)
    transform[:3, 3] = translation.ravel() * meters
    return transform


def _matrix(path: Path, table: dict[str, Any], names: tuple[str, ...]) -> tuple[str, NDArray[np.float64]]:
    """Return the first of these names in the table, and its numbers: a list, (N,), or rows, cols and data."""
    name = next((name for name in names if name in table), None)
    if name is None:
        raise CalibrationError(f"{path}: {names[0]}: missing; expected a matrix {' or '.join(names)}")
    values: Any = table[name]
    shape: list[Any] = [-1]
    if isinstance(values, dict):
        shape, values = [values.get("rows"), values.get("cols")], values.get("data")
        counts = all(type(count) is int and count > 0 for count in shape)
        if not counts or not isinstance(values, list) or len(values) != math.prod(shape):
            raise CalibrationError(
                f"{path}: {name}: expected rows x cols numbers in data, got {quoted(shape[0])} x "
                f"{quoted(shape[1])} and {len(values) if isinstance(values, list) else quoted(values)}"
            )
    if isinstance(values, list) and values and all(isinstance(row, list) for row in values):
        shape, values = [len(values), -1], [value for row in values for value in row]
        if len(values) % shape[0]:
            raise CalibrationError(f"{path}: {name}: expected rows of one length")
    if not isinstance(values, list):
        raise CalibrationError(
            f"{path}: {name}: expected a matrix or a list of numbers, got {quoted(values)}"
        )
    numbers = [number(path, name, value) for value in values]
    return name, np.array(numbers, dtype=np.float64).reshape(shape)
