"""Scenes of the BOP benchmark: a list gives each image its camera and its unit of depth."""

import re
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, RecordingFormatError, quoted
from nurbseg.common.files import read_file
from nurbseg.common.frame import rigid
from nurbseg.common.limits import LIST_BYTES_MAX
from nurbseg.common.structured_text import decode_text, parse_json, parse_yaml
from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel, number
from nurbseg.drivers.datasets.beside import MILLIMETRES
from nurbseg.drivers.datasets.folders import PairSource, Shot, moments_of_names
from nurbseg.drivers.datasets.pairs import find_pairs
from nurbseg.drivers.datasets.units import DepthUnits, decide_units
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.options import SourceOptions

#: The list of cameras, and what it was before, in the SIXD challenge.
_INDEX, _FORMER = "scene_camera.json", "info.yml"
#: The visible part of each object, by the numbers of the image and of the object in it.
_MASKS, _MASK = "mask_visib", re.compile(r"(\d{6})_(\d{6})\.png")


def index_of(folder: Path) -> Path | None:
    """Return the list of a scene's cameras; None if the folder is something else."""
    if (folder / _INDEX).is_file():
        return folder / _INDEX
    path = folder / _FORMER
    is_list = path.is_file() and "cam_K" in _text(path, "replace")
    return path if is_list else None


def open_bop(path: Path, options: SourceOptions) -> PairSource:
    """Open a scene of the BOP benchmark [1]_ by its list of cameras; its images are registered.

    `depth_scale` of an image is its unit in millimeters, and its pose is taken from `cam_R_w2c` and
    `cam_t_w2c` (millimeters). The labels are those of ``mask_visib``: one more than the number of the object
    in the image, so that scene_gt.json says what it is. Raises RecordingFormatError if there is no pair of
    images; CalibrationError if an image has no usable camera, and the user gives none.

    References
    ----------
    .. [1] T. Hodan et al., "BOP: Benchmark for 6D object pose estimation", ECCV 2018.
    """
    folder = path.parent
    pairs, single = find_pairs(folder)
    if not pairs:
        raise RecordingFormatError(f"{folder}: no image pairs; expected the folders rgb and depth")
    try:
        text = _text(path)
        table = parse_json(text) if path.suffix == ".json" else parse_yaml(text)
    except ValueError as err:
        raise RecordingFormatError(f"{path}: not valid {path.suffix[1:].upper()} ({err})") from err
    if not isinstance(table, dict):
        raise RecordingFormatError(f"{path}: expected a camera for each image, got {quoted(table)}")
    given = options.given_cameras()
    by_number = {int(key): each for key, each in table.items() if str(key).isdecimal()}
    units: dict[DepthUnit | None, DepthUnits] = {}
    shots = []
    masks = _masks(folder)
    for pair, moment_ns in zip(pairs, moments_of_names([pair.name for pair in pairs]), strict=True):
        index = int(pair.name) if pair.name.isdecimal() else -1
        stated = by_number.get(index)
        unit = None if not isinstance(stated, dict) else _unit(path, index, stated)
        if unit not in units:
            units[unit] = decide_units(options.depth_scale, unit, MILLIMETRES, ())
        cameras = given or _camera(path, index, stated)
        pair = replace(pair, labels=masks.get(index, pair.labels))
        shots.append(Shot(pair, cameras, units[unit], moment_ns, _pose(stated)))
    return PairSource(folder, shots, "BOP scene", dropped=len(single))


def _text(path: Path, errors: str = "strict") -> str:
    return decode_text(read_file(path, LIST_BYTES_MAX, what="index"), errors)


def _masks(folder: Path) -> dict[int, tuple[tuple[int, Path], ...]]:
    """Return the masks of each image, with their labels, in the order of the objects."""
    found: dict[int, list[tuple[int, Path]]] = defaultdict(list)
    for path in (folder / _MASKS).glob("*.png"):
        # As many as there are labels.
        if (match := _MASK.fullmatch(path.name)) is not None and int(match[2]) < 0xFFFF:
            found[int(match[1])].append((int(match[2]) + 1, path))
    return {index: tuple(sorted(masks)) for index, masks in found.items()}


def _pose(stated: Any) -> NDArray[np.float64] | None:
    """Return world_from_camera; None where it is not stated, or is none."""
    try:
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = np.array(stated["cam_R_w2c"], dtype=np.float64).reshape(3, 3)
        camera_from_world[:3, 3] = np.array(stated["cam_t_w2c"], dtype=np.float64) / 1000.0
        return np.asarray(np.linalg.inv(rigid("cam_R_w2c", camera_from_world)), dtype=np.float64)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None


def _unit(path: Path, index: int, stated: dict[str, Any]) -> DepthUnit | None:
    if "depth_scale" not in stated:
        return None
    if (scale := number(path, f"{index}.depth_scale", stated["depth_scale"])) <= 0:
        raise CalibrationError(f"{path}: {index}.depth_scale: expected millimeters over 0, got {scale:g}")
    return DepthUnit(float(f"{1000 / scale:.12g}"), f"{path.name}: depth_scale {scale:g}, in millimeters")


def _camera(path: Path, index: int, stated: Any) -> CameraFile:
    values = stated.get("cam_K") if isinstance(stated, dict) else None
    if not isinstance(values, list) or len(values) != 9:
        raise CalibrationError(f"{path}: {index}.cam_K: expected 9 numbers, got {quoted(values)}")
    matrix = np.array([number(path, f"{index}.cam_K", value) for value in values]).reshape(3, 3)
    camera = CameraModel(path, f"{index}.cam_K", matrix)
    return CameraFile(path=path, depth=camera, color=camera)
