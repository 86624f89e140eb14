"""Calibrations as plain text: matrices, four numbers, COLMAP's cameras, and lines of names and values."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from nurbseg.common.errors import CalibrationError, quoted
from nurbseg.common.structured_text import scalar
from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel, check_distortion_model, image_size

_FORMS = (
    "camera matrix: expected 3 rows of 3 numbers, or fx fy cx cy, or a calibration as TOML, OpenCV's XML or "
    "YAML, ROS's camera_info as YAML, or that of Kalibr, ORB-SLAM, Open3D, RealSense or COLMAP"
)
_COMMENTS = ("#", "//", "%", ";")
#: focal length x: 525.0, fx = 525.0
_NAMED_VALUE = re.compile(r"\s*([A-Za-z][\w .,=]*?)\s*[:=]\s*([^:=]+?)\s*")
_SECTION = re.compile(r"\s*\[[A-Za-z]\w*\]\s*")
#: [ 640x480  p[319.5 239.5]  f[615 615]  Inverse Brown Conrady [0 0 0 0 0] ], as librealsense prints one
_REALSENSE = re.compile(
    r"\W*(\d{1,5})x(\d{1,5})\s+p\[(\S+) (\S+)\]\s+f\[(\S+) (\S+)\]\s+([\w ]+?)\s*\[([^\]]*)\]\W*"
)
#: 1 PINHOLE 640 480 525 525 320 240, as COLMAP has one.
_COLMAP = re.compile(r"\s*\d+ ([A-Z][A-Z_0-9]+) (\d{1,5}) (\d{1,5})((?: [-+.\deE]+)+)\s*")
#: COLMAP's models by how many focal lengths come before the principal point, and OpenCV's order of the rest.
_COLMAP_MODELS = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, (0, None, None, None)),
    "RADIAL": (1, (0, 1, None, None)),
    "OPENCV": (2, (0, 1, 2, 3)),
    "FULL_OPENCV": (2, (0, 1, 2, 3, 4, 5, 6, 7)),
}
#: Shapes of a matrix in rows, and numbers of one on one line, by the shape they stand for.
_ROWS = {(3, 3): (3, 3), (3, 4): (3, 4), (4, 4): (4, 4), (1, 9): (3, 3), (1, 12): (3, 4), (1, 16): (4, 4)}


def cameras_of_text(path: Path, text: str) -> CameraFile:
    """Return the camera of registered images that a text states; its size may stay open.

    Raises CalibrationError if the text is of another form, or states more than one camera.
    """
    lines = _lines(text)
    cameras = [match for line in lines if (match := _COLMAP.fullmatch(line))]
    printed = [match for line in lines if (match := _REALSENSE.fullmatch(line))]
    if len(cameras) + len(printed) > 1:
        raise CalibrationError(f"{path}: has {len(cameras) + len(printed)} cameras; expected one")
    if cameras:
        model = _of_colmap(path, *cameras[0].groups())
    elif printed:
        model = _of_realsense(path, *printed[0].groups())
    else:
        model = _of_numbers(path, lines)
    return CameraFile(path=path, depth=model, color=model)


def matrix_of_text(path: Path, text: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the (3, 3), (3, 4) or (4, 4) matrix in a text; raises CalibrationError if it is another form."""
    try:
        rows = [[float(word) for word in re.sub(r"[\[\],;]", " ", line).split()] for line in _lines(text)]
    except ValueError as err:
        raise CalibrationError(f"{path}: {_FORMS} ({quoted(str(err))})") from err
    rows = [row for row in rows if row]
    if len({len(row) for row in rows}) == 1 and len(rows[0]) == 4 and len(rows) == 1:
        fx, fy, cx, cy = rows[0]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    shape = _ROWS.get((len(rows), len(rows[0]))) if rows and len({len(row) for row in rows}) == 1 else None
    if shape is None:
        raise CalibrationError(f"{path}: {_FORMS}, got rows of {quoted([len(row) for row in rows])}")
    return np.reshape(np.array(rows), shape)


def table_of_lines(path: Path, text: str) -> dict[str, Any] | None:
    """Return the values of lines with a name, a colon or equals sign and a value; None if they are others.

    Raises CalibrationError if a name has two values, as in a list of several cameras.
    """
    table: dict[str, Any] = {}
    for line in _lines(text):
        match = _NAMED_VALUE.fullmatch(line)
        if match is None:
            continue
        name, value = match[1], scalar(match[2])
        if table.setdefault(name, value) != value:
            raise CalibrationError(f"{path}: {name}: has two values; keep the lines of one camera")
    return table or None


def _lines(text: str) -> list[str]:
    return [
        line
        for line in text.splitlines()
        if line.strip() and not line.lstrip().startswith(_COMMENTS) and not _SECTION.fullmatch(line)
    ]


def _of_numbers(path: Path, lines: list[str]) -> CameraModel:
    matrix = matrix_of_text(path, "\n".join(lines))
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise CalibrationError(
            f"{path}: camera matrix: expected the last row 0 0 0 1, got {matrix[3].tolist()}"
        )
    if matrix.shape[1] == 4 and matrix[:3, 3].any():
        raise CalibrationError(
            f"{path}: camera matrix: expected a last column of 0, got {matrix[:3, 3].tolist()}"
        )
    return CameraModel(path, "camera matrix", matrix[:3, :3])


def _of_colmap(path: Path, model: str, width: str, height: str, rest: str) -> CameraModel:
    values = [float(word) for word in rest.split()]
    focal, order = _COLMAP_MODELS.get(model, (0, ()))
    taken = [place for place in order if place is not None]
    if not focal or len(values) != focal + 2 + len(taken):
        expected = ", ".join(_COLMAP_MODELS)
        raise CalibrationError(
            f"{path}: expected one of {expected} with its parameters, got {quoted(model + rest)}"
        )
    coefficients = values[focal + 2 :]
    distortion = np.array([0.0 if place is None else coefficients[place] for place in order])
    # COLMAP's first pixel is at half a pixel.
    cx, cy = values[focal] - 0.5, values[focal + 1] - 0.5
    matrix = np.array([[values[0], 0, cx], [0, values[focal - 1], cy], [0, 0, 1]])
    size = image_size(path, ("width", "height"), (int(width), int(height)))
    return CameraModel(path, model, matrix, distortion, size)


def _of_realsense(path: Path, width: str, height: str, *words: str) -> CameraModel:
    *places, model, coefficients = words
    try:
        cx, cy, fx, fy = map(float, places)
        distortion = np.array([float(word) for word in coefficients.replace(",", " ").split()])
    except ValueError as err:
        raise CalibrationError(f"{path}: expected numbers ({quoted(str(err))})") from err
    check_distortion_model(path, "distortion model", model, distortion)
    size = image_size(path, ("width", "height"), (int(width), int(height)))
    return CameraModel(path, "f, p", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), distortion, size)
