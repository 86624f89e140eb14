"""Folders of image pairs: a color and a depth image for each frame, perhaps with ground truth."""

import logging
import os
import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, FrameFormatError, RecordingFormatError
from nurbseg.common.files import read_file
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.common.limits import FRAME_BYTES_MAX, STAMP_END_NS
from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.calibration.foreign import ALONG_RAYS, is_along_rays
from nurbseg.drivers.datasets.beside import convention_of, find_beside
from nurbseg.drivers.datasets.images import GRAY, decode_color, decode_stored
from nurbseg.drivers.datasets.pairs import (
    NAMES_EXPECTED,
    ImagePair,
    find_pairs,
    is_aligned,
    match_patterns,
    why_unreadable,
)
from nurbseg.drivers.datasets.poses import pose_of_file, poses_of_pairs
from nurbseg.drivers.datasets.published import read_labels
from nurbseg.drivers.datasets.sequence import SequenceSource, natural_key
from nurbseg.drivers.datasets.units import DepthUnits, Sample, decide_units
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FRAME_INTERVAL_NS

_log = logging.getLogger(__name__)

#: frame_20121214T142255.814212: the moment in UTC, to the microsecond.
_MOMENT = re.compile(r"(\d{8}T\d{6}\.\d{1,6})")
#: 1700000000.25, 1700000000250: since 1970, in seconds with a fraction, milli-, micro- or nanoseconds.
_SINCE_1970 = re.compile(r"[A-Za-z_-]*(1\d{9})(?:\.(\d{1,9})|(\d{3}|\d{6}|\d{9}))")
#: Depth images that are looked at to decide their unit.
_SAMPLES = 4
#: Poses that are looked at, and how far apart those of a depth camera are at most, meters.
_POSES, _APART_MAX_M = 8, 100.0
_SCENE = re.compile(r"scene[ _-]?\d+", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Shot:
    """The files of one frame, what they are read with, and when they were taken, nanoseconds.

    `pose` is the camera's, world_from_camera, or the file that has it.
    """

    pair: ImagePair
    cameras: CameraFile
    units: DepthUnits
    timestamp_ns: int
    pose: NDArray[np.float64] | Path | None = None


class PairSource(SequenceSource):
    """Replays image files, in the order of `shots`.

    `form` is what kind of recording it is, for a person; `dropped` counts images left out because they have
    no partner. A label image that cannot be used costs the labels of its frame only; they are counted in
    ``metadata["unusable_labels"]``. Raises RecordingFormatError if none can be used.
    """

    def __init__(self, folder: Path, shots: list[Shot], form: str, dropped: int = 0) -> None:
        super().__init__(folder, len(shots), form)
        self._shots = shots
        self._sizes: tuple[tuple[int, int], tuple[int, int]] | None = None
        #: Cameras by those of a file that leaves the sizes of its images open.
        self._sized: dict[CameraFile, CameraFile] = {}
        self._has_other_sizes = False
        self._unusable_labels: set[int] = set()
        self.metadata |= {"dropped": str(dropped), "calibration": shots[0].cameras.path.name}
        units = shots[0].units
        first = self._first()
        self.calibration = first.calibration
        pair = shots[first.index].pair
        content = _content(pair.depth)
        self._state_depth_unit(units.of(content, decode_stored(content, str(pair.depth))))
        if units.doubts:
            self._warn_of_depth(str(folder), *units.doubts)
        if pair.color is None:
            _log.warning("%s: has no color images that can be read; the color is gray", folder)
        poses = [_pose(shots[len(shots) * part // _POSES]) for part in range(_POSES)]
        places_m = np.array([pose[:3, 3] for pose in poses if pose is not None]).reshape(-1, 3)
        if len(places_m) and (apart_m := np.ptp(places_m, axis=0).max()) > _APART_MAX_M:
            _log.warning("%s: the camera's poses are %.0f m apart: are they in millimeters?", folder, apart_m)

    def _pair(self, index: int) -> ImagePair:
        return self._shots[index].pair

    def _load(self, index: int) -> RGBDFrame:
        shot, pair = self._shots[index], self._pair(index)
        content = _content(pair.depth)
        stored = decode_stored(content, str(pair.depth))
        depth_mm = shot.units.of(content, stored).millimeters(stored)
        height, width = depth_mm.shape
        if pair.color is None:
            color = np.full((height, width, 3), GRAY, np.uint8)
        else:
            color = decode_color(_content(pair.color), str(pair.color))
        sizes = (width, height), (color.shape[1], color.shape[0])
        try:
            calibration = self._calibration_for(shot.cameras, index, *sizes, alone=pair.color is None)
        except CalibrationError as err:
            color_name = "" if pair.color is None else f"{pair.color} ({_size(color.shape)}) and "
            raise FrameFormatError(f"{color_name}{pair.depth.name} ({_size(depth_mm.shape)}): {err}") from err
        return RGBDFrame(
            index=index,
            timestamp_ns=shot.timestamp_ns,
            depth_mm=depth_mm,
            color=color,
            calibration=calibration,
            labels=self._labels(index, pair.labels, depth_mm, calibration),
            name=pair.name or (pair.color or pair.depth).stem,
            world_from_camera=_pose(shot),
        )

    def _calibration_for(
        self,
        cameras: CameraFile,
        index: int,
        depth_size: tuple[int, int],
        color_size: tuple[int, int],
        *,
        alone: bool,
    ) -> Calibration:
        """Return the calibration of a frame; sizes that a file leaves open are those of its first frame."""
        if cameras not in self._sized:
            self._sized[cameras] = cameras.with_sizes(depth_size, color_size)
        sized = self._sized[cameras]
        if alone:
            sized = replace(sized, color=sized.depth, color_from_depth=np.eye(4))
        calibration = _calibration(sized, depth_size, color_size)
        sizes = depth_size, color_size
        self._sizes = self._sizes or sizes
        if sizes != self._sizes and not self._has_other_sizes:
            self._has_other_sizes = True
            _log.warning(
                "%s: frame %d has images of another size; the calibration is scaled", self._path, index
            )
        return calibration

    def _labels(
        self,
        index: int,
        given: Path | tuple[tuple[int, Path], ...] | None,
        depth_mm: NDArray[np.uint16],
        calibration: Calibration,
    ) -> NDArray[np.uint16] | None:
        """Return the labels of a frame; None if there are none that can be used, which is said once."""
        self.labels_fault = ""
        if given is None:
            return None
        try:
            if isinstance(given, Path):
                return read_labels(given, depth_mm, calibration)
            labels = np.zeros(depth_mm.shape, np.uint16)
            for label, path in given:
                labels[read_labels(path, depth_mm, calibration) > 0] = label
            return labels
        except FrameFormatError as err:
            wrong = str(err)
        self.labels_fault = wrong
        if not self._unusable_labels:
            _log.warning("%s; the frame has no labels, nor have others whose label image is unusable", wrong)
        self._unusable_labels.add(index)
        self.metadata["unusable_labels"] = str(len(self._unusable_labels))
        return None


def open_folder(folder: Path, options: SourceOptions) -> PairSource:
    """Open a folder of image pairs, to be replayed in the natural order of their names.

    Depth is in millimeters unless the folder, its form or the user says otherwise. A calibration of one
    camera (intrinsics.txt and the like) stands for both images, which are taken to be registered. For images
    of another size but the same aspect ratio, the intrinsics are scaled. Time is taken from names like
    ``frame_20121214T142255.814212``, else frames are 1/30 s apart. Raises RecordingFormatError if there is no
    pair, or none that can be used; CalibrationError if there is no calibration, or an unusable one.
    """
    pairs, single = find_pairs(folder)
    if not pairs:
        alone = f" ({len(single)} images lack their partner)" if single else ""
        for path in single:
            if (kind := why_unreadable(path)) is not None:
                raise RecordingFormatError(f"{path}: cannot be read: {kind}")
        raise RecordingFormatError(f"{folder}: no image pairs{alone}; expected {NAMES_EXPECTED}")
    shots = shots_of(folder, pairs, options)
    if single:
        named = ", ".join(path.name for path in single[:3]) + (" ..." if len(single) > 3 else "")
        _log.warning(
            "%s: %d images are left out, since they lack their partner: %s", folder, len(single), named
        )
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
    files = [file.absolute() for pair in pairs for file in (pair.color, pair.depth) if file is not None]
    folder = Path(os.path.commonpath([file.parent for file in files]))
    return PairSource(folder, shots_of(folder, pairs, options), "image pairs", dropped)


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
        for shot in shots_of(scene, pairs, options):
            name = f"{scene.name}_{shot.pair.name}" if shot.pair.name else scene.name
            moment_ns = len(shots) * FRAME_INTERVAL_NS
            shots.append(replace(shot, pair=replace(shot.pair, name=name), timestamp_ns=moment_ns))
    return PairSource(folder, shots, "folder of scenes")


def shots_of(
    folder: Path,
    pairs: list[ImagePair],
    options: SourceOptions,
    *,
    convention: DepthUnit | None = None,
    moments_ns: list[int] | None = None,
) -> list[Shot]:
    """Return pairs of images with what stands beside them, their folder's calibration and unit of depth.

    Time is that given, else that in the names, else the images are 1/30 s apart. Raises CalibrationError as
    `nurbseg.drivers.datasets.beside.find_beside` does, and RecordingFormatError as `units_of`.
    """
    cameras = find_beside(folder, options)
    if is_aligned(pairs[0].depth) and cameras.color is not cameras.depth and options.given_cameras() is None:
        text = "%s: depth is registered to color, by its name: the color camera in %s is used for both"
        _log.warning(text, folder, cameras.path.name)
        cameras = replace(cameras, depth=cameras.color, color_from_depth=np.eye(4))
    convention = convention or convention_of(folder, pairs[0].depth)
    units = units_of([pair.depth for pair in pairs], options, cameras.depth_unit, convention)
    moments = moments_ns or moments_of_names([pair.name for pair in pairs])
    return [
        Shot(pair, cameras, units, moment, pose)
        for pair, moment, pose in zip(pairs, moments, poses_of_pairs(folder, pairs), strict=True)
    ]


def units_of(
    paths: list[Path], options: SourceOptions, stated: DepthUnit | None, convention: DepthUnit
) -> DepthUnits:
    """Decide the units of depth images by some of them, from the first to the last.

    Raises RecordingFormatError if they are distances along the rays.
    """
    first = paths[0]
    # SceneNet RGB-D calls its color photo.
    if is_along_rays(first.stem) or (first.parent.name == "depth" and (first.parents[1] / "photo").is_dir()):
        raise RecordingFormatError(f"{first}: {ALONG_RAYS}")
    samples: list[Sample] = []
    chosen = {len(paths) * part // (2 * _SAMPLES) for part in range(2 * _SAMPLES)}
    for place in sorted(chosen):
        try:
            content = _content(paths[place])
            samples.append((content[:2], decode_stored(content, str(paths[place]))))
        except FrameFormatError:
            # It is named when its frame is read.
            continue
        if len(samples) == _SAMPLES:
            break
    return decide_units(options.depth_scale, stated, convention, samples)


@lru_cache(maxsize=4)
def _calibration(
    cameras: CameraFile, depth_size: tuple[int, int], color_size: tuple[int, int]
) -> Calibration:
    """Return the calibration for images of these sizes, the same one for all frames that share it."""
    return cameras.calibration(depth_size=depth_size, color_size=color_size)


def _content(path: Path) -> bytes:
    return read_file(path, FRAME_BYTES_MAX, what="image", error=FrameFormatError)


def _pose(shot: Shot) -> NDArray[np.float64] | None:
    return pose_of_file(shot.pose) if isinstance(shot.pose, Path) else shot.pose


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"


def moments_of_names(names: list[str]) -> list[int]:
    """Return the times in names, nanoseconds; 1/30 s apart if they are not in all of them, or do not rise."""
    moments = [moment for name in names if (moment := _moment_ns(name)) is not None]
    rises = all(later > earlier for earlier, later in pairwise(moments))
    if rises and len(moments) == len(names):
        return moments
    return [i * FRAME_INTERVAL_NS for i in range(len(names))]


def _moment_ns(name: str) -> int | None:
    if (since := _SINCE_1970.fullmatch(name)) is not None:
        return int(since[1] + (since[2] or since[3]).ljust(9, "0"))
    match = _MOMENT.search(name)
    if match is None:
        return None
    try:
        moment = datetime.strptime(match[1], "%Y%m%dT%H%M%S.%f").replace(tzinfo=UTC)
    except ValueError:
        return None
    moment_ns = int(moment.timestamp()) * 1_000_000_000 + moment.microsecond * 1000
    return moment_ns if 0 <= moment_ns < STAMP_END_NS else None
