"""Calibrations in the tables of other programs: Kalibr, ORB-SLAM, Open3D, RealSense, nerfstudio, ScanNet."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, quoted
from nurbseg.common.frame import rigid
from nurbseg.common.structured_text import scalar
from nurbseg.drivers.calibration.cameras import (
    CameraFile,
    CameraModel,
    check_distortion_model,
    image_size,
    is_distortion,
    number,
)
from nurbseg.drivers.depth_unit import DepthUnit

_log = logging.getLogger(__name__)

#: What programs call the values of a camera, the first being ours.
_NAMES = {
    "fx": ("fx", "fl_x", "focal length x", "focal_x", "focal_length_x", "Fx"),
    "fy": ("fy", "fl_y", "focal length y", "focal_y", "focal_length_y", "Fy"),
    "cx": ("cx", "ppx", "principal point x", "center_x", "principal_point_x", "mx", "PPX"),
    "cy": ("cy", "ppy", "principal point y", "center_y", "principal_point_y", "my", "PPY"),
    "width": ("width", "w", "cols", "image_width", "resolution width", "imageWidth", "Width"),
    "height": ("height", "h", "rows", "image_height", "resolution height", "imageHeight", "Height"),
    "model": ("distortion_model", "model", "camera_model", "type", "Distortion"),
}
#: A camera's distortion one by one, in OpenCV's order.
_COEFFICIENTS = (
    ("k1",),
    ("k2",),
    ("p1", "tangential distortion coefficient x"),
    ("p2", "tangential distortion coefficient y"),
    ("k3",),
    ("k4",),
    ("k5",),
    ("k6",),
)
#: What a list of numbers in a text begins with.
_FIRST_NUMBER = re.compile(r"[\[(\s]*[-+.]*\d")
_AZURE_CENTERS = ("center of distortion in Z=1 plane, x", "center of distortion in Z=1 plane, y")
_DEPTH_WORDS = {"depth", "ir", "infra", "infra1", "infrared", "tof"}
_COLOR_WORDS = {"color", "colour", "rgb"}
#: Names of a depth unit in units per meter, ...
_PER_METRE = (
    "DepthMapFactor",
    "RGBD.DepthMapFactor",
    "depthmap_factor",
    "Camera.depthmap_factor",
    "png_depth_scale",
    "depth_factor",
    "factor_depth",
    "depthShift",
    "depth_shift",
    "m_depthShift",
)
#: ... in meters per unit, ...
_METRES = ("depth_unit_scale_factor", "integer_depth_scale", "depth_units")
#: ... and one that programs use for either, and for millimeters per unit.
_ANY = ("depth_scale", "depthScale")


def cameras_of_program(path: Path, table: Any) -> CameraFile | None:
    """Return the cameras in a table of another program's; None if it is of none that is known.

    Raises CalibrationError if a value is unusable.
    """
    if not isinstance(table, dict):
        return None
    if isinstance(table.get("cam0"), dict):
        return _kalibr(path, table)
    if isinstance(table.get("intrinsics"), list) and "resolution" in table:
        # A camera alone, as EuRoC's sensor.yaml.
        coefficients = table.get("distortion_coefficients", table.get("distortion_coeffs", []))
        return _kalibr(path, {"cam0": {**table, "distortion_coeffs": coefficients}})
    if "CalibrationInformation" in table:
        raise CalibrationError(
            f"{path}: CalibrationInformation: the factory calibration of an Azure Kinect is of its whole "
            "sensor; save that of the recorded mode instead: its calibration_info prints it"
        )
    if any(str(key).startswith("Camera2.") for key in table):
        raise CalibrationError(f"{path}: Camera2: expected the one camera of registered images")
    if "fx_depth" in table and "fx_color" in table:
        depth, color = ({_suffixless(key, word): table[key] for key in table} for word in ("depth", "color"))
        step = _rigid(path, "colorToDepthExtrinsics", table.get("colorToDepthExtrinsics"))
        models = _flat(path, depth, "fx_depth"), _flat(path, color, "fx_color")
        return two_cameras(path, *models, None if step is None else np.array(np.linalg.inv(step), np.float64))
    if "m_calibrationColorIntrinsic" in table:
        return _of_sensor(path, table)
    for prefixes in (("Camera.", "Camera1."), ("",)):
        camera = {
            str(key).removeprefix(prefix): value
            for prefix in prefixes
            for key, value in table.items()
            if str(key).startswith(prefix)
        }
        if _is_camera(camera):
            return _one(path, _flat(path, camera, f"{prefixes[0]}fx"))
    return _nested(path, table)


def stated_unit(path: Path, table: Any) -> DepthUnit | None:
    """Return the unit of depth that a table states, itself or one level deeper; None if it states none.

    Raises CalibrationError if a value is no unit.
    """
    if not isinstance(table, dict):
        return None
    tables = {"": table} | {f"{key}.": each for key, each in table.items() if isinstance(each, dict)}
    for place, each in tables.items():
        for key in each:
            field = f"{place}{key}"
            if key in _PER_METRE or (key == "scale" and place == "camera."):
                return _unit(path, field, each[key], ", per meter")
            if key in _METRES:
                return _unit(path, field, each[key], ", in meters")
            if key in _ANY:
                return _unit(path, field, each[key])
    return None


def _unit(path: Path, field: str, value: Any, meaning: str | None = None) -> DepthUnit:
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if (scale := number(path, field, value)) <= 0:
        raise CalibrationError(f"{path}: {field}: expected a unit over 0, got {quoted(value)}")
    if meaning is None:
        # No camera has units of more than a centimeter, or of less than a hundredth of a millimeter.
        if scale <= 0.01:
            meaning = ", in meters"
        elif scale <= 10:
            meaning = ", in millimeters"
        elif scale >= 100:
            meaning = ", per meter"
        else:
            raise CalibrationError(
                f"{path}: {field}: expected units per meter, or a unit in mm or meters, got {scale:g}"
            )
    per_metre = {", per meter": scale, ", in meters": 1 / scale, ", in millimeters": 1000 / scale}[meaning]
    return DepthUnit(float(f"{per_metre:.12g}"), f"{path.name}: {field} {scale:g}{meaning}")


def _is_camera(table: Any) -> bool:
    return isinstance(table, dict) and any(name in table for name in (*_NAMES["fx"], "intrinsic_matrix"))


def _flat(path: Path, table: dict[str, Any], field: str) -> CameraModel:
    """Return the camera whose values have names of their own."""
    matrix = np.eye(3)
    if "intrinsic_matrix" in table:
        field = field.replace("fx", "intrinsic_matrix")
        matrix = np.reshape(_numbers(path, field, table["intrinsic_matrix"], (9,)), (3, 3))
    else:
        for name, place in {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}.items():
            key = _named(table, name)
            if key not in table:
                raise CalibrationError(f"{path}: {field.replace('fx', name)}: missing; expected pixels")
            matrix[place] = number(path, field.replace("fx", key), table[key])
    if any(number(path, key, table[key]) for key in _AZURE_CENTERS if key in table):
        raise CalibrationError(
            f"{path}: {_AZURE_CENTERS[0]}: expected 0, as OpenCV's model has no such center"
        )
    distortion = _distortion(path, table, field)
    model = table.get(_named(table, "model"))
    if isinstance(stated := table.get("distortion"), str) and not _FIRST_NUMBER.match(stated):
        model = stated
    check_distortion_model(path, "distortion model", model, distortion)
    keys = _named(table, "width"), _named(table, "height")
    size = image_size(path, keys, (table.get(keys[0]), table.get(keys[1])))
    return CameraModel(path, field, matrix, distortion, size)


def _distortion(path: Path, table: dict[str, Any], field: str) -> NDArray[np.float64]:
    for name, value in table.items():
        if isinstance(value, dict) and value.keys() & {key for keys in _COEFFICIENTS for key in keys}:
            return _distortion(path, value, name)
        is_list = _FIRST_NUMBER.match(value) if isinstance(value, str) else isinstance(value, list | dict)
        if value and is_list and is_distortion(path, name):
            values = _numbers(path, name, value)
            # Two radial coefficients are what is left of four.
            return np.array([*values, 0.0, 0.0] if len(values) == 2 else values)
    found = [next((table[key] for key in keys if key in table), 0.0) for keys in _COEFFICIENTS]
    values = [number(path, keys[0], value) for keys, value in zip(_COEFFICIENTS, found, strict=True)]
    fewest = next(count for count in (0, 4, 5, 8) if not any(values[count:]))
    return np.array(values[:fewest])


def _named(table: dict[str, Any], name: str) -> str:
    return next((key for key in _NAMES[name] if key in table), name)


def _nested(path: Path, table: dict[str, Any]) -> CameraFile | None:
    """Return the cameras in the tables within a table, told apart by the words of their names."""
    found = {str(key): each for key, each in table.items() if _is_camera(each)}
    depth, color = (
        [key for key in found if words & set(re.split(r"[\W_]+", key.casefold()))]
        for words in (_DEPTH_WORDS, _COLOR_WORDS)
    )
    if len(found) == 1:
        ((key, camera),) = found.items()
        # Its distortion or size may stand beside it.
        return _one(path, _flat(path, table | camera, f"{key}.fx"))
    if len(depth) != 1 or len(color) != 1:
        if found:
            raise CalibrationError(
                f"{path}: expected one camera, or one called depth and one color, got {quoted([*found])}"
            )
        return None
    step = None
    for name in ("color_from_depth", "depth_to_color", "extrinsics_depth_to_color", "extrinsics"):
        if name in table:
            by_columns = "ppx" in found[depth[0]]
            step = _rigid(path, name, table[name], by_columns=by_columns)
            break
    if any(isinstance(each, list | dict) and is_distortion(path, name) for name, each in table.items()):
        raise CalibrationError(f"{path}: distortion: beside two cameras; expected one in each of them")
    models = [_flat(path, found[key], f"{key}.fx") for key in (depth[0], color[0])]
    return two_cameras(path, models[0], models[1], step)


def _kalibr(path: Path, table: dict[str, Any]) -> CameraFile:
    names = [name for name in (f"cam{n}" for n in range(len(table))) if isinstance(table.get(name), dict)]
    models, chain = [], [np.eye(4)]
    for name in names:
        camera = table[name]
        if camera.get("camera_model", "pinhole") != "pinhole":
            raise CalibrationError(
                f"{path}: {name}.camera_model: expected pinhole, got {quoted(camera['camera_model'])}"
            )
        fx, fy, cx, cy = _numbers(path, f"{name}.intrinsics", camera.get("intrinsics"), (4,))
        distortion = np.array(
            _numbers(path, f"{name}.distortion_coeffs", camera.get("distortion_coeffs", []))
        )
        field = f"{name}.distortion_model"
        check_distortion_model(path, field, camera.get("distortion_model"), distortion)
        size = _numbers(path, f"{name}.resolution", camera.get("resolution"), (2,))
        pixels = image_size(path, (f"{name}.resolution",) * 2, (size[0], size[1]))
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        models.append(CameraModel(path, f"{name}.intrinsics", matrix, distortion, pixels))
        if name != "cam0":
            step = _rigid(path, f"{name}.T_cn_cnm1", camera.get("T_cn_cnm1"))
            if step is None:
                raise CalibrationError(f"{path}: {name}.T_cn_cnm1: missing; expected 4 rows of 4 numbers")
            chain.append(step @ chain[-1])
    if len(models) == 1:
        return _one(path, models[0])
    words = [set(re.split(r"[\W_]+", str(table[name].get("rostopic", "")).casefold())) for name in names]
    depth, color = (
        [place for place, word in enumerate(words) if wanted & word]
        for wanted in (_DEPTH_WORDS, _COLOR_WORDS)
    )
    if len(models) == 2 and (len(depth) != 1 or len(color) != 1 or depth == color):
        if len(depth) == 1:
            color = [1 - depth[0]]
        elif len(color) == 1:
            depth = [1 - color[0]]
        else:
            depth, color = [0], [1]
            _log.warning("%s: cam0 is taken for the depth camera, as no rostopic says which is", path)
    if len(depth) != 1 or len(color) != 1:
        raise CalibrationError(
            f"{path}: rostopic: expected one camera with depth or ir in it and one with color"
        )
    d, c = depth[0], color[0]
    return two_cameras(path, models[d], models[c], chain[c] @ np.linalg.inv(chain[d]))


def _of_sensor(path: Path, table: dict[str, Any]) -> CameraFile:
    """Return the cameras of a .sens file's description."""
    models, places = [], []
    for word in ("Depth", "Color"):
        name, lower = f"m_calibration{word}Intrinsic", word.lower()
        matrix = np.reshape(_numbers(path, name, table.get(name), (16,)), (4, 4))[:3, :3]
        keys = f"m_{lower}Width", f"m_{lower}Height"
        size = image_size(path, keys, (table.get(keys[0]), table.get(keys[1])))
        models.append(CameraModel(path, name, matrix, size=size))
        name = f"m_calibration{word}Extrinsic"
        places.append(_rigid(path, name, table.get(name)))
    # Each takes points of its camera to what they have in common.
    known = [place for place in places if place is not None]
    step = np.linalg.inv(known[1]) @ known[0] if len(known) == 2 else None
    return two_cameras(path, models[0], models[1], step)


def _one(path: Path, camera: CameraModel) -> CameraFile:
    return CameraFile(path=path, depth=camera, color=camera)


def two_cameras(
    path: Path, depth: CameraModel, color: CameraModel, color_from_depth: NDArray[np.float64] | None
) -> CameraFile:
    """Return two cameras as a file's; alike ones without a transform are one, the images being registered.

    Without a transform, others are taken to be at one place, with a warning.
    """
    if color_from_depth is None:
        if depth.size == color.size and np.array_equal(depth.matrix, color.matrix):
            return _one(path, depth)
        _log.warning("%s: no transform between the two cameras; they are taken to be at one place", path)
        color_from_depth = np.eye(4)
    return CameraFile(path=path, depth=depth, color=color, color_from_depth=color_from_depth)


def _rigid(path: Path, field: str, value: Any, *, by_columns: bool = False) -> NDArray[np.float64] | None:
    """Return the (4, 4) transform in rows, 16 numbers, or a rotation and a translation; None for None."""
    if value is None:
        return None
    if isinstance(value, dict):
        transform = np.eye(4)
        rotation = np.reshape(_numbers(path, f"{field}.rotation", value.get("rotation"), (9,)), (3, 3))
        # librealsense, alone, keeps its matrices by columns.
        transform[:3, :3] = rotation.T if by_columns else rotation
        transform[:3, 3] = _numbers(path, f"{field}.translation", value.get("translation"), (3,))
    else:
        transform = np.reshape(_numbers(path, field, value, (16,)), (4, 4))
    try:
        return rigid(field, transform)
    except ValueError as err:
        raise CalibrationError(f"{path}: {err}") from err


def _numbers(path: Path, field: str, values: Any, counts: tuple[int, ...] = ()) -> list[float]:
    """Return the numbers of a list, of lists, or of a text with spaces."""
    if isinstance(values, str):
        values = [scalar(word) for word in re.sub(r"[\[\](),;]", " ", values).split()]
    if not isinstance(values, list):
        raise CalibrationError(f"{path}: {field}: expected a list of numbers, got {quoted(values)}")
    flat = [value for row in values for value in (row if isinstance(row, list) else [row])]
    if counts and len(flat) not in counts:
        raise CalibrationError(f"{path}: {field}: expected {counts[0]} numbers, got {len(flat)}")
    return [number(path, field, value) for value in flat]


def _suffixless(key: str, word: str) -> str:
    """Return ScanNet's name of one camera's value as others call it: fx_depth, colorWidth."""
    plain = key.removesuffix(f"_{word}")
    return plain.removeprefix(word).casefold() if plain == key and key.startswith(word) else plain
