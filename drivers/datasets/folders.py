"""Folders of image pairs: a color and a depth image for each frame, perhaps with ground truth."""

import os
import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from urllib.parse import parse_qsl

from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.calibration.file import read_camera_file
from nurbseg.drivers.datasets.images import decode_color, decode_depth, decode_labels
from nurbseg.drivers.datasets.pairs import NAMES_EXPECTED, ImagePair, find_pairs, match_patterns
from nurbseg.drivers.datasets.sequence import FRAME_INTERVAL_NS, SequenceSource, natural_key
from nurbseg.drivers.errors import CalibrationError, FrameFormatError, RecordingFormatError
from nurbseg.drivers.files import read_file
from nurbseg.drivers.frame import Calibration, RGBDFrame
from nurbseg.drivers.limits import FRAME_BYTES_MAX, STAMP_END_NS
from nurbseg.drivers.options import SourceOptions

#: Where a folder's calibration is looked for; the first found counts.
_CALIBRATION_PATTERNS = (
    "camera.toml",
    "calib*.xml",
    "calib*.yml",
    "calib*.yaml",
    "camera_info.yaml",
    "intrinsics.txt",
    "camera-intrinsics.txt",
)
#: frame_20121214T142255.814212: the moment in UTC, to the microsecond.
_MOMENT = re.compile(r"(\d{8}T\d{6}\.\d{1,6})")
_SCENE = re.compile(r"scene[ _-]?\d+", re.IGNORECASE)


def folder_cameras(folder: Path, options: SourceOptions) -> CameraFile:
    """Return how to read a folder's images: as the user says, else by a calibration file in it.

    The files looked for are, in this order, ``camera.toml``, OpenCV's ``calib*.xml|yml|yaml``, ROS's
    ``camera_info.yaml``, ``intrinsics.txt`` and ``camera-intrinsics.txt``. Raises CalibrationError if there
    is none, or it is unusable.
    """
    cameras = options.given_cameras()
    if cameras is None:
        path = next((p for pattern in _CALIBRATION_PATTERNS for p in sorted(folder.glob(pattern))), None)
        if path is None:
            raise CalibrationError(
                f"{folder}: no calibration: add camera.toml, OpenCV's calib.xml or calib.yml, ROS's "
                "camera_info.yaml or intrinsics.txt, or give --intrinsics fx,fy,cx,cy (pixels)"
            )
        cameras = read_camera_file(path)
    return replace(cameras, depth_scale=options.depth_scale or cameras.depth_scale)


@dataclass(frozen=True, slots=True)
class Shot:
    """The files of one frame, what they are read with, and when they were taken, nanoseconds."""

    pair: ImagePair
    cameras: CameraFile
    timestamp_ns: int


class PairSource(SequenceSource):
    """Replays image files, in the order of `shots`.

    `form` is what kind of recording it is, for a person; `dropped` counts images left out because they have
    no partner. Raises RecordingFormatError if none can be used.
    """

    #: Depth scale where neither the user nor the folder gives one.
    _units_per_metre = 1000.0

    def __init__(self, folder: Path, shots: list[Shot], form: str, dropped: int = 0) -> None:
        super().__init__(folder, len(shots), form)
        self._shots = shots
        self.metadata |= {"dropped": str(dropped), "calibration": shots[0].cameras.path.name}
        self.calibration = self._first_calibration()

    def _pair(self, index: int) -> ImagePair:
        return self._shots[index].pair

    def _load(self, index: int) -> RGBDFrame:
        shot, pair = self._shots[index], self._pair(index)
        color = decode_color(_content(pair.color), str(pair.color))
        scale = shot.cameras.depth_scale or self._units_per_metre
        depth_mm = decode_depth(_content(pair.depth), str(pair.depth), units_per_metre=scale)
        height, width = depth_mm.shape
        try:
            calibration = _calibration(shot.cameras, (width, height), (color.shape[1], color.shape[0]))
        except CalibrationError as err:
            raise FrameFormatError(
                f"{pair.color} ({_size(color.shape)}) and {pair.depth.name} ({_size(depth_mm.shape)}): {err}"
            ) from err
        labels = None
        if pair.labels is not None:
            labels = decode_labels(_content(pair.labels), str(pair.labels))
            if labels.shape != depth_mm.shape:
                raise FrameFormatError(
                    f"{pair.labels}: expected the depth image's size {_size(depth_mm.shape)}, "
                    f"got {_size(labels.shape)}"
                )
        return RGBDFrame(
            index=index,
            timestamp_ns=shot.timestamp_ns,
            depth_mm=depth_mm,
            color=color,
            calibration=calibration,
            labels=labels,
            name=pair.name or pair.color.stem,
        )


def open_folder(folder: Path, options: SourceOptions) -> PairSource:
    """Open a folder of image pairs, to be replayed in the natural order of their names.

    Depth is in millimetres unless the folder or the user says otherwise. A calibration of one camera
    (intrinsics.txt and the like) stands for both images, which are taken to be registered. For images of
    another size but the same aspect ratio, the intrinsics are scaled. Time is taken from names like
    ``frame_20121214T142255.814212``, else frames are 1/30 s apart. Raises RecordingFormatError if there is no
    pair, or none that can be used; CalibrationError if there is no calibration, or an unusable one.
    """
    pairs, single = find_pairs(folder)
    if not pairs:
        alone = f" ({len(single)} images lack their partner)" if single else ""
        raise RecordingFormatError(f"{folder}: no image pairs{alone}; expected {NAMES_EXPECTED}")
    shots = _shots(pairs, folder_cameras(folder, options))
    return PairSource(folder, shots, "folder of image pairs", dropped=len(single))


def open_patterns(rest: str, options: SourceOptions) -> PairSource:
    """Open what follows ``images:``, ``?color=GLOB&depth=GLOB``: the images that match two patterns.

    A calibration is looked for in the folder that holds all of them. Raises RecordingFormatError if a pattern
    is missing, or as `nurbseg.drivers.datasets.pairs.match_patterns` and `open_folder` do; CalibrationError
    as `open_folder` does.
    """
    patterns = dict(parse_qsl(rest.removeprefix("?")))
    if patterns.keys() != {"color", "depth"}:
        raise RecordingFormatError(f"images:{rest}: expected images:?color=GLOB&depth=GLOB")
    pairs, dropped = match_patterns(**patterns)
    files = [file.absolute() for pair in pairs for file in (pair.color, pair.depth)]
    folder = Path(os.path.commonpath([file.parent for file in files]))
    return PairSource(folder, _shots(pairs, folder_cameras(folder, options)), "image pairs", dropped)


def scene_folders(folder: Path) -> list[Path]:
    """Return the scenes of a data set in natural order; none if the folder is something else."""
    found = [path for path in folder.iterdir() if path.is_dir() and _SCENE.fullmatch(path.name)]
    return sorted(found, key=lambda path: natural_key(path.name))


def open_scenes(folder: Path, options: SourceOptions) -> PairSource:
    """Open a data set with a folder for each scene, one at least, as that of the paper (LTTM), one by one.

    The folders are called ``scene1`` or ``scene_1`` and so on. Each has its own calibration, and its images,
    ground truth included, under names that `find_pairs` knows.

    Raises RecordingFormatError if a scene has no pair of images; CalibrationError if one has no calibration,
    or an unusable one.
    """
    shots: list[Shot] = []
    for scene in scene_folders(folder):
        pairs, _ = find_pairs(scene)
        if not pairs:
            raise RecordingFormatError(f"{scene}: no image pairs; expected {NAMES_EXPECTED}")
        cameras = folder_cameras(scene, options)
        for pair in pairs:
            name = f"{scene.name}_{pair.name}" if pair.name else scene.name
            shots.append(Shot(replace(pair, name=name), cameras, len(shots) * FRAME_INTERVAL_NS))
    return PairSource(folder, shots, "folder of scenes")


def _shots(pairs: list[ImagePair], cameras: CameraFile) -> list[Shot]:
    moments = [_moment_ns(pair.name) for pair in pairs]
    if any(moment is None for moment in moments):
        moments = [index * FRAME_INTERVAL_NS for index in range(len(pairs))]
    return [Shot(pair, cameras, moment or 0) for pair, moment in zip(pairs, moments, strict=True)]


@lru_cache(maxsize=4)
def _calibration(
    cameras: CameraFile, depth_size: tuple[int, int], color_size: tuple[int, int]
) -> Calibration:
    """Return the calibration for images of these sizes, the same one for all frames that share it."""
    return cameras.calibration(depth_size=depth_size, color_size=color_size)


def _content(path: Path) -> bytes:
    return read_file(path, FRAME_BYTES_MAX, what="image", error=FrameFormatError)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"


def _moment_ns(name: str) -> int | None:
    match = _MOMENT.search(name)
    if match is None:
        return None
    try:
        moment = datetime.strptime(match[1], "%Y%m%dT%H%M%S.%f").replace(tzinfo=UTC)
    except ValueError:
        return None
    moment_ns = int(moment.timestamp()) * 1_000_000_000 + moment.microsecond * 1000
    return moment_ns if 0 <= moment_ns < STAMP_END_NS else None
