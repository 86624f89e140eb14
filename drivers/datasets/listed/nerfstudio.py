"""Captures of nerfstudio and Polycam: a transforms.json, or a file for each frame, has cameras and poses."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, RecordingFormatError, quoted
from nurbseg.common.files import read_file, visible
from nurbseg.common.frame import rigid
from nurbseg.common.limits import LIST_BYTES_MAX, TEXT_BYTES_MAX
from nurbseg.common.structured_text import decode_text, parse_json
from nurbseg.drivers.calibration.programs import cameras_of_program, stated_unit
from nurbseg.drivers.datasets.beside import find_beside
from nurbseg.drivers.datasets.folders import PairSource, Shot, units_of
from nurbseg.drivers.datasets.pairs import ImagePair
from nurbseg.drivers.datasets.poses import OPENGL_FROM_OURS
from nurbseg.drivers.datasets.sequence import natural_key
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FRAME_INTERVAL_NS

INDEX = "transforms.json"
_PATHS = ("file_path", "depth_file_path")
_FILE, _CAMERA = "the file that states the camera", ("fx", "fy", "cx", "cy", "width", "height")


def lists_depth(folder: Path) -> bool:
    """Whether a folder's list names a depth image, or it has Polycam's files."""
    path = folder / INDEX
    if not path.is_file():
        return bool(_keyframes(folder))
    return "depth_file_path" in _text(path, errors="replace")


def open_transforms(folder: Path, options: SourceOptions) -> PairSource:
    """Open a capture; its images are registered, and depth is in millimeters unless the list says otherwise.

    Polycam's raw data have a file with the camera and pose of each frame in place of the list. Frames are in
    the order of their names, and may each have a camera of their own. Raises RecordingFormatError if the list
    is damaged, names no pair, or one outside the folder; CalibrationError if it has no usable camera, and the
    user gives none.
    """
    path = folder / INDEX
    whole = (
        _table(path)
        if path.is_file()
        else {"frames": [_of_polycam(keyframe) for keyframe in _keyframes(folder)]}
    )
    frames = whole.pop("frames", None)
    listed = [frame for frame in frames if isinstance(frame, dict)] if isinstance(frames, list) else []
    paired = [each for each in listed if all(isinstance(each.get(name), str) for name in _PATHS)]
    if not paired:
        raise RecordingFormatError(f"{path}: frames: expected file_path and depth_file_path, got none")
    # COLMAP lists them in any order.
    paired.sort(key=lambda each: natural_key(each["file_path"]))
    pairs = [
        ImagePair(Path(each["depth_file_path"]).stem, *(_inside(folder, each[name]) for name in _PATHS))
        for each in paired
    ]
    if options.given_cameras() is None and any("fl_x" in each or "fx" in each for each in paired):
        cameras: list[Any] = [cameras_of_program(each.get(_FILE, path), whole | each) for each in paired]
        unit = stated_unit(path, whole)
        if None in cameras:
            name = quoted(paired[cameras.index(None)]["file_path"])
            raise CalibrationError(f"{path}: frames: {name}: fl_x: missing; expected pixels")
    else:
        beside = find_beside(folder, options)
        cameras, unit = [beside] * len(paired), beside.depth_unit
    convention = DepthUnit(1000.0, "nerfstudio's and Polycam's own")
    units = units_of([pair.depth for pair in pairs], options, unit, convention)
    has_meters = whole.get("applied_scale", 1) == 1
    shots = [
        Shot(pair, camera, units, index * FRAME_INTERVAL_NS, _pose(each) if has_meters else None)
        for index, (each, pair, camera) in enumerate(zip(paired, pairs, cameras, strict=True))
    ]
    return PairSource(folder, shots, "transforms.json", dropped=len(listed) - len(pairs))


def _keyframes(folder: Path) -> list[Path]:
    """Return the files of Polycam's raw data, one a frame; none if the folder is something else."""
    found = visible(folder / "cameras", "*.json") if (folder / "depth").is_dir() else []
    return found if found and "t_00" in _text(found[0], errors="replace") else []


def _of_polycam(path: Path) -> dict[str, Any]:
    """Return a frame of Polycam's raw data as transforms.json lists one."""
    stated = _table(path, TEXT_BYTES_MAX)
    rows = [[stated.get(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    names = {"file_path": f"images/{path.stem}.jpg", "depth_file_path": f"depth/{path.stem}.png"}
    camera = {key: stated[key] for key in _CAMERA if key in stated}
    return camera | names | {"transform_matrix": [*rows, [0, 0, 0, 1]], _FILE: path}


def _text(path: Path, most: int = LIST_BYTES_MAX, *, errors: str = "strict") -> str:
    return decode_text(read_file(path, most, what="index"), errors)


def _table(path: Path, most: int = LIST_BYTES_MAX) -> dict[str, Any]:
    try:
        table = parse_json(_text(path, most))
    except ValueError as err:
        raise RecordingFormatError(f"{path}: not valid JSON ({err})") from err
    return table if isinstance(table, dict) else {}


def _pose(stated: dict[str, Any]) -> NDArray[np.float64] | None:
    """Return world_from_camera; None where it is not stated, or is none."""
    with suppress(KeyError, TypeError, ValueError, OverflowError):
        pose = np.array(stated["transform_matrix"], np.float64).reshape(4, 4)
        return rigid("transform_matrix", pose) @ OPENGL_FROM_OURS
    return None


def _inside(folder: Path, name: Any) -> Path:
    path = folder / str(name)
    if not path.resolve().is_relative_to(folder.resolve()):
        raise RecordingFormatError(f"{folder / INDEX}: {quoted(name)}: is outside the folder; copy it there")
    return path
