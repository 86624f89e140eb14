"""Captures with a transforms.json, as of nerfstudio or Polycam: it lists the images of each frame."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, RecordingFormatError, quoted
from nurbseg.common.files import read_file
from nurbseg.common.frame import rigid
from nurbseg.common.limits import LIST_BYTES_MAX
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


def lists_depth(folder: Path) -> bool:
    """Whether a folder's list names a depth image."""
    path = folder / INDEX
    return path.is_file() and b"depth_file_path" in read_file(path, LIST_BYTES_MAX, what="index")


def open_transforms(folder: Path, options: SourceOptions) -> PairSource:
    """Open a capture; its images are registered, and depth is in millimeters unless the list says otherwise.

    Frames are in the order of their names, and may each have a camera of their own. Raises
    RecordingFormatError if the list is damaged, names no pair, or one outside the folder; CalibrationError if
    it has no usable camera, and the user gives none.
    """
    path = folder / INDEX
    try:
        table = parse_json(decode_text(read_file(path, LIST_BYTES_MAX, what="index")))
    except ValueError as err:
        raise RecordingFormatError(f"{path}: not valid JSON ({err})") from err
    whole = table if isinstance(table, dict) else {}
    frames = whole.pop("frames", None)
    listed = [each for each in frames if isinstance(each, dict)] if isinstance(frames, list) else []
    paired = [each for each in listed if all(isinstance(each.get(name), str) for name in _PATHS)]
    if not paired:
        raise RecordingFormatError(f"{path}: frames: expected file_path and depth_file_path, got none")
    # COLMAP lists them in any order.
    paired.sort(key=lambda each: natural_key(each["file_path"]))
    pairs = [
        ImagePair(Path(each["depth_file_path"]).stem, *(_inside(folder, each[name]) for name in _PATHS))
        for each in paired
    ]
    given = options.given_cameras()
    if given is None and any("fl_x" in each for each in paired):
        cameras = [cameras_of_program(path, whole | each) for each in paired]
        unit = stated_unit(path, whole)
    else:
        beside = find_beside(folder, options)
        cameras, unit = [beside.cameras] * len(paired), beside.unit
    convention = DepthUnit(1000.0, "transforms.json: depth is in millimeters")
    units = units_of([pair.depth for pair in pairs], options, unit, convention)
    shots = []
    for index, (each, pair, camera) in enumerate(zip(paired, pairs, cameras, strict=True)):
        if camera is None:
            raise CalibrationError(
                f"{path}: frames: {quoted(each['file_path'])}: fl_x: missing; expected pixels"
            )
        pose = _pose(each) if whole.get("applied_scale", 1) == 1 else None
        shots.append(Shot(pair, camera, units, index * FRAME_INTERVAL_NS, pose))
    return PairSource(folder, shots, "transforms.json", dropped=len(listed) - len(pairs))


def _pose(stated: dict[str, Any]) -> NDArray[np.float64] | None:
    """Return world_from_camera; None where it is not stated, or is none."""
    with suppress(KeyError, TypeError, ValueError):
        pose = np.array(stated["transform_matrix"], np.float64).reshape(4, 4)
        return rigid("transform_matrix", pose) @ OPENGL_FROM_OURS
    return None


def _inside(folder: Path, name: Any) -> Path:
    path = folder / str(name)
    if not path.resolve().is_relative_to(folder.resolve()):
        raise RecordingFormatError(f"{folder / INDEX}: {quoted(name)}: is outside the folder; copy it there")
    return path
