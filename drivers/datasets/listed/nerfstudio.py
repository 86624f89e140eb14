"""Captures with a transforms.json, as of nerfstudio or Polycam: it lists the images of each frame."""

from pathlib import Path
from typing import Any

from nurbseg.common.errors import RecordingFormatError, quoted
from nurbseg.common.files import read_file
from nurbseg.common.limits import LIST_BYTES_MAX
from nurbseg.common.structured_text import decode_text, parse_json
from nurbseg.drivers.datasets.folders import PairSource, shots_of
from nurbseg.drivers.datasets.pairs import ImagePair
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.options import SourceOptions

INDEX = "transforms.json"
_PATHS = ("file_path", "depth_file_path")


def lists_depth(folder: Path) -> bool:
    """Whether a folder's list names a depth image."""
    path = folder / INDEX
    return path.is_file() and b"depth_file_path" in read_file(path, LIST_BYTES_MAX, what="index")


def open_transforms(folder: Path, options: SourceOptions) -> PairSource:
    """Open a capture; its images are registered, and depth is in millimeters unless the list says otherwise.

    Raises RecordingFormatError if the list is damaged, names no pair, or one outside the folder;
    CalibrationError if it has no usable camera, and the user gives none.
    """
    path = folder / INDEX
    try:
        table = parse_json(decode_text(read_file(path, LIST_BYTES_MAX, what="index")))
    except ValueError as err:
        raise RecordingFormatError(f"{path}: not valid JSON ({err})") from err
    frames = table.get("frames") if isinstance(table, dict) else None
    listed = [each for each in frames if isinstance(each, dict)] if isinstance(frames, list) else []
    pairs = [
        ImagePair(Path(each["depth_file_path"]).stem, *(_inside(folder, each[name]) for name in _PATHS))
        for each in listed
        if all(isinstance(each.get(name), str) for name in _PATHS)
    ]
    if not pairs:
        raise RecordingFormatError(f"{path}: frames: expected file_path and depth_file_path, got none")
    for each in listed:
        if any(name in each for name in ("fl_x", "cx")):
            raise RecordingFormatError(
                f"{path}: frames: a camera for each frame is not read; state one for all: fl_x, fl_y, cx, cy"
            )
    convention = DepthUnit(1000.0, "transforms.json: depth is in millimeters")
    shots = shots_of(folder, pairs, options, convention=convention)
    return PairSource(folder, shots, "transforms.json", dropped=len(listed) - len(pairs))


def _inside(folder: Path, name: Any) -> Path:
    path = folder / str(name)
    if not path.resolve().is_relative_to(folder.resolve()):
        raise RecordingFormatError(f"{folder / INDEX}: {quoted(name)}: is outside the folder; copy it there")
    return path
