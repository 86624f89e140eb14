"""Reads and writes files that hold a sensor's calibration.

It reads our TOML, OpenCV's XML or YAML, ROS's ``camera_info`` YAML, and a 3 x 3 matrix as text, which some
data sets have; the form is recognized by the content. It writes TOML.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.calibration import matrices
from nurbseg.drivers.calibration.cameras import (
    CameraFile,
    CameraModel,
    calibration_table,
    image_size,
    number,
)
from nurbseg.drivers.errors import CalibrationError, quoted
from nurbseg.drivers.files import read_file
from nurbseg.drivers.frame import Calibration
from nurbseg.drivers.limits import TEXT_BYTES_MAX
from nurbseg.drivers.structured_text import parse_toml

_FORMS = (
    "camera matrix: expected 3 rows of 3 numbers, or a calibration as TOML, OpenCV's XML or YAML, or ROS's "
    "camera_info as YAML"
)
_CAMERA_KEYS = {"width", "height", "fx", "fy", "cx", "cy", "distortion"}
_FILE_KEYS = {"registered", "depth_scale", "color_from_depth", "depth", "color"}


def read_camera_file(path: Path) -> CameraFile:
    """Read what a calibration file says of the cameras and the depth scale; image sizes may stay open.

    Raises CalibrationError if the file is missing, of an unknown form, lacks a field or holds an unusable
    value; the message names the file and the field.
    """
    content = read_file(path, TEXT_BYTES_MAX, what="calibration", error=CalibrationError)
    try:
        text = content.decode()
    except UnicodeDecodeError as err:
        raise CalibrationError(f"{path}: expected text, got bytes that are not UTF-8") from err
    head, suffix = text.lstrip("\ufeff \t\r\n"), path.suffix.lower()
    if suffix == ".toml":
        return _from_toml(path, text)
    if head.startswith("<"):
        return matrices.from_xml(path, head)
    if head.startswith("%YAML") or suffix in (".yaml", ".yml"):
        return matrices.from_yaml(path, head)
    return _from_matrix_text(path, text)


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as TOML; raises OSError if the file cannot be written."""
    registered = calibration.is_registered
    table = calibration_table(calibration)
    lines = [
        "# Calibration of an RGB-D sensor: focal lengths and principal points in pixels, lengths in metres,",
        "# distortion as OpenCV orders it (k1, k2, p1, p2, k3, ...).",
        f"registered = {str(registered).lower()}  # whether depth is registered to color already",
    ]
    if not registered:
        rows = [f"  {row}," for row in table["color_from_depth"]]
        lines += ["# p_color = color_from_depth @ p_depth", "color_from_depth = [", *rows, "]"]
    for name in ("color",) if registered else ("color", "depth"):
        lines += ["", f"[{name}]", *(f"{key} = {value}" for key, value in table[name].items())]
    path.write_text("\n".join(lines) + "\n")


def _from_toml(path: Path, text: str) -> CameraFile:
    try:
        table = parse_toml(text)
    except ValueError as err:
        raise CalibrationError(f"{path}: not valid TOML ({err})") from err
    return cameras_of_table(path, table)


def cameras_of_table(path: Path, table: Any) -> CameraFile:
    """Return the cameras of a table as in `calibration_table`; raises CalibrationError if it is not one."""
    _check_keys(path, "", table, _FILE_KEYS)
    registered = table.get("registered", False)
    if not isinstance(registered, bool):
        raise CalibrationError(f"{path}: registered: expected true or false, got {quoted(registered)}")
    scale = table.get("depth_scale")
    if scale is not None and number(path, "depth_scale", scale) <= 0:
        raise CalibrationError(f"{path}: depth_scale: expected units per metre over 0, got {quoted(scale)}")
    cameras = {name: _toml_camera(path, name, table[name]) for name in ("depth", "color") if name in table}
    if not cameras:
        raise CalibrationError(f"{path}: color: the table is missing; expected [color] with fx, fy, cx, cy")
    if registered:
        if "color_from_depth" in table:
            raise CalibrationError(f"{path}: color_from_depth: registered images have none; remove one")
        # The registered depth image has the color camera's geometry, whichever camera took it.
        camera = cameras.get("color") or cameras["depth"]
        return CameraFile(path=path, depth=camera, color=camera, depth_scale=scale)
    for name in ("depth", "color"):
        if name not in cameras:
            raise CalibrationError(
                f"{path}: {name}: the table is missing; one camera needs registered = true"
            )
    if "color_from_depth" not in table:
        raise CalibrationError(
            f"{path}: color_from_depth: missing; expected 4 rows of 4 numbers (metres), or registered = true"
        )
    return CameraFile(
        path=path,
        depth=cameras["depth"],
        color=cameras["color"],
        color_from_depth=_toml_matrix(path, table["color_from_depth"]),
        depth_scale=scale,
    )


def _toml_camera(path: Path, name: str, table: Any) -> CameraModel:
    _check_keys(path, f"{name}.", table, _CAMERA_KEYS)
    values = {}
    for key in ("fx", "fy", "cx", "cy"):
        if key not in table:
            raise CalibrationError(f"{path}: {name}.{key}: missing; expected pixels")
        values[key] = number(path, f"{name}.{key}", table[key])
    size = None
    if "width" in table or "height" in table:
        fields, values_px = (f"{name}.width", f"{name}.height"), (table.get("width"), table.get("height"))
        size = image_size(path, fields, values_px)
    distortion = table.get("distortion", [])
    if not isinstance(distortion, list):
        raise CalibrationError(f"{path}: {name}.distortion: expected a list, got {quoted(distortion)}")
    coefficients = [number(path, f"{name}.distortion", value) for value in distortion]
    matrix = np.array([[values["fx"], 0, values["cx"]], [0, values["fy"], values["cy"]], [0, 0, 1]])
    return CameraModel(path, name, matrix, np.array(coefficients), size)


def _toml_matrix(path: Path, rows: Any) -> NDArray[np.float64]:
    field = "color_from_depth"
    if not isinstance(rows, list) or [isinstance(row, list) and len(row) for row in rows] != [4] * 4:
        raise CalibrationError(f"{path}: {field}: expected 4 rows of 4 numbers, got {quoted(rows)}")
    return np.array([[number(path, field, value) for value in row] for row in rows])


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


def _from_matrix_text(path: Path, text: str) -> CameraFile:
    lines = [
        line.replace(",", " ").split() for line in text.splitlines() if not line.lstrip().startswith("#")
    ]
    try:
        rows = [[float(word) for word in words] for words in lines if words]
    except ValueError as err:
        raise CalibrationError(f"{path}: {_FORMS} ({quoted(str(err))})") from err
    if [len(row) for row in rows] != [3, 3, 3]:
        raise CalibrationError(f"{path}: {_FORMS}, got rows of {quoted([len(row) for row in rows])}")
    camera = CameraModel(path, "camera matrix", np.array(rows))
    return CameraFile(path=path, depth=camera, color=camera)
