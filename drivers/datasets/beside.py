"""Finds what stands beside a folder's images: calibration files, and the unit of depth."""

import logging
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError
from nurbseg.common.files import visible
from nurbseg.common.limits import TEXT_BYTES_MAX
from nurbseg.common.structured_text import decode_text
from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel
from nurbseg.drivers.calibration.file import read_camera_file, read_depth_unit, read_transform
from nurbseg.drivers.calibration.programs import two_cameras
from nurbseg.drivers.datasets.published import known_cameras
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.options import SourceOptions

_log = logging.getLogger(__name__)

MILLIMETRES = DepthUnit(1000.0, "whole numbers are in millimeters")

#: Where a folder's calibration is looked for; the first found counts.
_CALIBRATION_PATTERNS = (
    "camera.toml",
    "calib*.xml",
    "calib*.yml",
    "calib*.yaml",
    "camera_info.yaml",
    "intrinsics.txt",
    "camera-intrinsics.txt",
    "camera_intrinsic*.json",
    "intrinsic*.json",
    "calib*.json",
    "camera.json",
    "cam_params.json",
    "../cam_params.json",
    "../../cam_params.json",
    "transforms.json",
    "camera_matrix.csv",
    "calib*.txt",
    "intrinsic.txt",
    "camera_intrinsics.txt",
    "cam_K.txt",
    "K.txt",
    "*camchain*.yaml",
    "camera.yaml",
    "camera.yml",
    "cameras.txt",
)
#: Where two calibrations of one camera each are looked for, and the words that tell them apart.
_TWO_FOLDERS = ("", "intrinsic", "intrinsics", "calibration", "calib")
_CAMERA_WORDS = {"intrinsic", "intrinsics", "camera", "calibration", "calib", "info", "k", "cam", "ps1080"}
_DEPTH_WORDS, _COLOR_WORDS = {"depth", "ir"}, {"color", "colour", "rgb"}
_TEXTS = (".txt", ".json", ".yaml", ".yml", ".xml", ".toml")
#: Files that state a unit but no camera.
_UNIT_PATTERNS = (
    *("config.json", "config.yaml", "meta.json", "metadata.json", "info.json"),
    *("_info.txt", "*_info.txt"),
)
#: Files of recordings whose images have this unit.
_SIGNS = {
    DepthUnit(5000.0, "TUM RGB-D's own"): (
        "associations.txt",
        "association.txt",
        "associated.txt",
        "associate.txt",
        "groundtruth.txt",
        "accelerometer.txt",
        "rgb.txt",
        "depth.txt",
    ),
    DepthUnit(1000.0, "SUN RGB-D's own", "rotated"): (
        "depth_bfx",
        "annotation2Dfinal",
        "annotation3Dfinal",
        "seg.mat",
    ),
    DepthUnit(10_000.0, "YCB-Video's own"): ("*-meta.mat",),
}
#: Calibrations that are known by what is in them: ORB-SLAM's settings are called like the sequence or the
#: camera; BundleFusion, 3RScan and 12-Scenes have what programs write of a .sens file.
_ANY_NAMES = ("*.yaml", "*.yml", "*info.txt", "../info.txt")
_KNOWN_CONTENT = re.compile(r"^(Camera1?\.fx\s*:|m_calibrationColorIntrinsic\s*=)", re.MULTILINE)
#: How far two cameras that are meant to be one may be apart, as a share of the focal length.
_DIFFERENT = 0.02
#: Names of depth images that tell their unit.
_NAMED = {
    DepthUnit(4000.0, "Matterport3D's own"): re.compile(r"[0-9a-f]{32}_d\d_\d"),
    DepthUnit(512.0, "2D-3D-S's own"): re.compile(r"camera_[0-9a-f]{32}_\w+_domain_depth"),
    DepthUnit(512.0, "Taskonomy's own"): re.compile(r"point_\d+_view_\d+_domain_depth_zbuffer"),
    DepthUnit(10_000.0, "Falling Things' own"): re.compile(r"\d{6}\.(left|right)\.depth"),
}
#: The size of the images of whose camera Stray Scanner writes the matrix.
_STRAY_SCANNER_SIZE = (1920, 1440)


def find_beside(folder: Path, options: SourceOptions) -> CameraFile:
    """Return the cameras of a folder's images: as the user says, else by a calibration file in it.

    `docs/recordings.md` lists the files looked for. The unit is that of the file the user names, else of the
    first of all files there that states one; the log warns of another one that differs. Raises
    CalibrationError if there is no calibration, or it is unusable.
    """
    cameras = options.given_cameras()
    units = [] if cameras is None or cameras.depth_unit is None else [cameras.depth_unit]
    for files in _calibrations(folder):
        try:
            found = _read(*files)
        except CalibrationError as err:
            if cameras is None:
                raise
            _log.warning("%s; it is not needed", err)
            with suppress(CalibrationError):
                units += filter(None, [read_depth_unit(files[0])])
            continue
        cameras = cameras or found
        if options.given_cameras() is None and _differ(cameras, found):
            _log.warning(
                "%s: the first counts of two cameras that differ: %s, %s", folder, cameras.path, found.path
            )
        units += [found.depth_unit] if found.depth_unit is not None else []
    cameras = cameras or known_cameras(folder)
    if cameras is None:
        raise CalibrationError(
            f"{folder}: no calibration: add camera.toml, OpenCV's calib.xml or calib.yml, ROS's "
            "camera_info.yaml or intrinsics.txt, or give --intrinsics fx,fy,cx,cy (pixels)"
        )
    return replace(cameras, depth_unit=_stated_unit([*units, *_units(folder)]))


def _differ(one: CameraFile, other: CameraFile) -> bool:
    """Whether the depth cameras of two files are of one image size, or of no stated one, but not the same."""
    a, b = one.depth.matrix, other.depth.matrix
    return one.depth.size == other.depth.size and bool(np.abs(a - b).max() > _DIFFERENT * abs(a[0, 0]))


def convention_of(folder: Path, first: Path) -> DepthUnit:
    """Return the unit of whole-numbered depth that recordings of a folder's form have.

    `first` is one of the depth images.
    """
    for unit, name in _NAMED.items():
        if name.fullmatch(first.stem):
            return unit
    for unit, names in _SIGNS.items():
        if any(visible(folder, name) for name in names):
            return unit
    return MILLIMETRES


def _calibrations(folder: Path) -> Iterator[tuple[Path, ...]]:
    """Yield the calibration files of a folder, one or two that belong together, the first being preferred."""
    own = [path for pattern in _CALIBRATION_PATTERNS for path in visible(folder, pattern) if path.is_file()]
    before = (
        own[:1] if own and own[0].name in ("camera.toml", "intrinsics.txt", "camera-intrinsics.txt") else []
    )
    yield from ((path,) for path in before)
    pair = _two_files(folder)
    if pair is not None:
        yield pair
    own += [path for path in _known_by_content(folder) if path not in own]
    yield from ((path,) for path in own if path not in before and path not in (pair or ()))


def _known_by_content(folder: Path) -> list[Path]:
    found = []
    for path in sorted(path for name in _ANY_NAMES for path in visible(folder, name)):
        if path.is_file():
            with path.open("rb") as file:
                if _KNOWN_CONTENT.search(decode_text(file.read(TEXT_BYTES_MAX), "replace")):
                    found.append(path)
    return found


def _two_files(folder: Path) -> tuple[Path, Path] | None:
    """Return the files of the depth and of the color camera; None if there is not one of each."""
    for place in _TWO_FOLDERS:
        if not (folder / place).is_dir():
            continue
        depth, color = [], []
        for path in visible(folder / place):
            words = set(re.split(r"[\W_]+", path.stem.casefold()))
            is_camera = path.suffix.lower() in _TEXTS and path.is_file() and (words & _CAMERA_WORDS)
            if is_camera and words & _DEPTH_WORDS:
                depth.append(path)
            elif is_camera and words & _COLOR_WORDS:
                color.append(path)
        if len(depth) == 1 and len(color) == 1:
            return depth[0], color[0]
    return None


def _read(path: Path, color_path: Path | None = None) -> CameraFile:
    """Read a calibration file, or those of the depth and of the color camera."""
    found = read_camera_file(path)
    if path.name == "camera_matrix.csv":
        camera = replace(found.depth, size=_STRAY_SCANNER_SIZE)
        return replace(found, depth=camera, color=camera)
    if color_path is None:
        return found
    color: CameraModel = read_camera_file(color_path).color
    step, of_color, of_depth = None, _extrinsics(path.parent, "color"), _extrinsics(path.parent, "depth")
    if of_color is not None and of_depth is not None:
        # Each takes points of its camera to what they have in common.
        step = np.linalg.inv(of_color) @ of_depth
    both = two_cameras(path, found.depth, color, step).in_meters(stated=False)
    return replace(both, depth_unit=found.depth_unit)


def _extrinsics(folder: Path, word: str) -> NDArray[np.float64] | None:
    path = next(iter(visible(folder, f"extrinsic*_{word}.txt")), None)
    if path is None:
        return None
    return read_transform(path)


def _units(folder: Path) -> Iterator[DepthUnit]:
    """Yield the units that files state which need have no camera."""
    patterns = (
        *_UNIT_PATTERNS,
        f"{folder.name}.txt" if re.fullmatch(r"scene\w+", folder.name) else "_info.txt",
    )
    for path in dict.fromkeys(path for pattern in patterns for path in visible(folder, pattern)):
        try:
            unit = read_depth_unit(path)
        except CalibrationError as err:
            _log.warning("%s; it is not needed", err)
            continue
        if unit is not None:
            yield unit


def _stated_unit(units: list[DepthUnit]) -> DepthUnit | None:
    for other in units[1:]:
        if other.units_per_meter != units[0].units_per_meter:
            _log.warning("depth: the first counts of two units that differ: %s, %s", units[0], other)
    return units[0] if units else None
