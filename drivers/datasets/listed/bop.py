"""Scenes of the BOP benchmark: scene_camera.json gives each image its camera and its unit of depth."""

from pathlib import Path
from typing import Any

import numpy as np

from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel, number
from nurbseg.drivers.datasets.beside import MILLIMETRES
from nurbseg.drivers.datasets.folders import PairSource, Shot, moments_of_names
from nurbseg.drivers.datasets.pairs import find_pairs
from nurbseg.drivers.datasets.units import DepthUnits, decide_units
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.errors import CalibrationError, RecordingFormatError, quoted
from nurbseg.drivers.files import read_file
from nurbseg.drivers.limits import LIST_BYTES_MAX
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.structured_text import decode_text, parse_json

INDEX = "scene_camera.json"


def open_bop(folder: Path, options: SourceOptions) -> PairSource:
    """Open a scene of the BOP benchmark [1]_, whose images are registered.

    `depth_scale` of an image is its unit in millimetres. Raises RecordingFormatError if there is no pair of
    images; CalibrationError if an image has no usable camera, and the user gives none.

    References
    ----------
    .. [1] T. Hodan et al., "BOP: Benchmark for 6D object pose estimation", ECCV 2018.
    """
    path = folder / INDEX
    pairs, single = find_pairs(folder)
    if not pairs:
        raise RecordingFormatError(f"{folder}: no image pairs; expected the folders rgb and depth")
    try:
        table = parse_json(decode_text(read_file(path, LIST_BYTES_MAX, what="index")))
    except ValueError as err:
        raise RecordingFormatError(f"{path}: not valid JSON ({err})") from err
    given = options.given_cameras()
    by_number = {int(key): each for key, each in table.items() if str(key).isdecimal()} if table else {}
    units: dict[DepthUnit | None, DepthUnits] = {}
    shots = []
    for pair, moment_ns in zip(pairs, moments_of_names([pair.name for pair in pairs]), strict=True):
        index = int(pair.name) if pair.name.isdecimal() else -1
        stated = by_number.get(index)
        unit = None if not isinstance(stated, dict) else _unit(path, index, stated)
        if unit not in units:
            units[unit] = decide_units(options.depth_scale, unit, MILLIMETRES, ())
        cameras = given or _camera(path, index, stated)
        shots.append(Shot(pair, cameras, units[unit], moment_ns))
    return PairSource(folder, shots, "BOP scene", dropped=len(single))


def _unit(path: Path, index: int, stated: dict[str, Any]) -> DepthUnit | None:
    if "depth_scale" not in stated:
        return None
    if (scale := number(path, f"{index}.depth_scale", stated["depth_scale"])) <= 0:
        raise CalibrationError(f"{path}: {index}.depth_scale: expected millimetres over 0, got {scale:g}")
    return DepthUnit(float(f"{1000 / scale:.12g}"), f"{path.name}: depth_scale {scale:g}, in millimetres")


def _camera(path: Path, index: int, stated: Any) -> CameraFile:
    values = stated.get("cam_K") if isinstance(stated, dict) else None
    if not isinstance(values, list) or len(values) != 9:
        raise CalibrationError(f"{path}: {index}.cam_K: expected 9 numbers, got {quoted(values)}")
    matrix = np.array([number(path, f"{index}.cam_K", value) for value in values]).reshape(3, 3)
    camera = CameraModel(path, f"{index}.cam_K", matrix)
    return CameraFile(path=path, depth=camera, color=camera)
