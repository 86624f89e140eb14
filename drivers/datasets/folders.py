"""Folders of image pairs: a color and a depth image for each frame, perhaps with ground truth."""

import logging
import os
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, FrameFormatError, RecordingFormatError
from nurbseg.common.files import read_file
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.common.limits import FRAME_BYTES_MAX
from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.calibration.foreign import by_name
from nurbseg.drivers.datasets.beside import find_cameras, pose_file, pose_of_file, read_labels
from nurbseg.drivers.datasets.images import GRAY, decode_color, decode_stored
from nurbseg.drivers.datasets.pairs import NAMES_EXPECTED, ImagePair, find_pairs, is_depth, match_patterns
from nurbseg.drivers.datasets.sequence import SequenceSource, natural_key
from nurbseg.drivers.depth_unit import MILLIMETERS, DepthUnit, ImageUnits, decided_unit
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FRAME_INTERVAL_NS

_log = logging.getLogger(__name__)

#: Depth images by which the default unit is checked.
_SAMPLES = 4
Size = tuple[int, int]
_SCENE = re.compile(r"scene[ _-]?\d+", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Shot:
    """The files of one frame, what they are read with, and when they were taken, nanoseconds.

    `pose` is the camera's, world_from_camera, or the file that has it.
    """

    pair: ImagePair
    cameras: CameraFile
    units: ImageUnits
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
        #: Sizes of the first frame's images; and cameras by those of a file that leaves their sizes open.
        self._sizes: tuple[Size, Size] | None = None
        self._sized: dict[CameraFile, CameraFile] = {}
        self._has_other_sizes = False
        self._calibration = lru_cache(maxsize=4)(self._calibration_for)
        self._unusable_labels: set[int] = set()
        self.metadata |= {"dropped": str(dropped), "calibration": shots[0].cameras.path.name}
        first = self._first()
        self.calibration = first.calibration
        depth = shots[first.index].pair.depth
        self._state_depth_unit(shots[0].units.of(decode_stored(_content(depth), str(depth))))
        if shots[first.index].pair.color is None:
            _log.warning("%s: has no color images that can be read; the color is gray", folder)

    def _pair(self, index: int) -> ImagePair:
        return self._shots[index].pair

    def _load(self, index: int) -> RGBDFrame:
        shot, pair = self._shots[index], self._pair(index)
        stored = decode_stored(_content(pair.depth), str(pair.depth))
        depth_mm = shot.units.of(stored).millimeters(stored)
        if pair.color is None:
            color = np.full((*depth_mm.shape, 3), GRAY, np.uint8)
        else:
            color = decode_color(_content(pair.color), str(pair.color))
        (height, width), (color_height, color_width) = depth_mm.shape, color.shape[:2]
        sizes = (width, height), (color_width, color_height)
        try:
            calibration = self._calibration(shot.cameras, *sizes, pair.color is None)
        except CalibrationError as err:
            color_name = "" if pair.color is None else f"{pair.color} ({_size(sizes[1])}) and "
            raise FrameFormatError(f"{color_name}{pair.depth.name} ({_size(sizes[0])}): {err}") from err
        self._sizes = self._sizes or sizes
        if sizes != self._sizes and not self._has_other_sizes:
            self._has_other_sizes = True
            text = "%s: frame %d has images of another size; the calibration is scaled"
            _log.warning(text, self._path, index)
        return RGBDFrame(
            index=index,
            timestamp_ns=shot.timestamp_ns,
            depth_mm=depth_mm,
            color=color,
            calibration=calibration,
            labels=self._labels(index, depth_mm, calibration),
            name=pair.name or (pair.color or pair.depth).stem,
            world_from_camera=pose_of_file(shot.pose) if isinstance(shot.pose, Path) else shot.pose,
        )

    def _calibration_for(
        self, cameras: CameraFile, depth_size: Size, color_size: Size, alone: bool
    ) -> Calibration:
        """Return the calibration for images of these sizes; a file may leave them to its first frame's."""
        sized = self._sized.setdefault(cameras, cameras.with_sizes(depth_size, color_size))
        if alone:
            sized = replace(sized, color=sized.depth, color_from_depth=np.eye(4))
        return sized.calibration(depth_size=depth_size, color_size=color_size)

    def _labels(
        self, index: int, depth_mm: NDArray[np.uint16], calibration: Calibration
    ) -> NDArray[np.uint16] | None:
        """Return the labels of a frame; None, with one warning, if there are none that can be used."""
        self.labels_fault = ""
        path = self._shots[index].pair.labels
        try:
            return None if path is None else read_labels(path, depth_mm, calibration)
        except FrameFormatError as err:
            self.labels_fault = str(err)
        if not self._unusable_labels:
            text = "%s; the frame has no labels, nor have others whose label image is unusable"
            _log.warning(text, self.labels_fault)
        self._unusable_labels.add(index)
        self.metadata["unusable_labels"] = str(len(self._unusable_labels))
        return None


def open_folder(folder: Path, options: SourceOptions) -> PairSource:
    """Open a folder of image pairs, or of scenes, to be replayed in the natural order of their names.

    Scenes are folders called ``scene1`` or ``scene_1`` and so on, each with its own calibration, as those of
    the paper. Depth is in millimeters, and floating-point depth in meters, unless ``camera.toml`` or the user
    states another unit. A calibration of one camera (intrinsics.txt and the like) stands for both images,
    which are taken to be registered. For images of another size but the same aspect ratio, the intrinsics are
    scaled. Frames are 1/30 s apart. Raises RecordingFormatError if there is no pair, none that can be used,
    or the depth is implausible in a unit that nobody stated; CalibrationError if there is no calibration, or
    an unusable one.
    """
    shots: list[Shot] = []
    single: list[Path] = []
    scenes = [] if find_pairs(folder)[0] else scene_folders(folder)
    for scene in scenes or [folder]:
        pairs, lacking = find_pairs(scene)
        if not pairs:
            for path in lacking:
                if is_depth(path) and (kind := by_name(path)) is not None:
                    raise RecordingFormatError(f"{path}: cannot be read: {kind}")
            alone = f" ({len(lacking)} images lack their partner)" if lacking else ""
            raise RecordingFormatError(f"{scene}: no image pairs{alone}; expected {NAMES_EXPECTED}")
        if scenes:
            names = ("_".join(filter(None, (scene.name, pair.name))) for pair in pairs)
            pairs = [replace(pair, name=name) for pair, name in zip(pairs, names, strict=True)]
        shots += shots_of(scene, pairs, options, first=len(shots))
        single += lacking
    if single:
        named = ", ".join(path.name for path in single[:3]) + (" ..." if len(single) > 3 else "")
        text = "%s: %d images are left out, since they lack their partner: %s"
        _log.warning(text, folder, len(single), named)
    form = "folder of scenes" if scenes else "folder of image pairs"
    return PairSource(folder, shots, form, dropped=len(single))


def scene_folders(folder: Path) -> list[Path]:
    """Return the scenes of a data set in natural order; none if the folder is something else."""
    found = [path for path in folder.iterdir() if path.is_dir() and _SCENE.fullmatch(path.name)]
    return sorted(found, key=lambda path: natural_key(path.name))


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


def shots_of(
    folder: Path,
    pairs: list[ImagePair],
    options: SourceOptions,
    *,
    layout: DepthUnit | None = None,
    moments_ns: list[int] | None = None,
    first: int = 0,
) -> list[Shot]:
    """Return pairs of images with what stands beside them, their folder's calibration and unit of depth.

    `layout` is the unit of whole-numbered depth that the folder's layout defines. Without `moments_ns` the
    images are 1/30 s apart, from that of frame `first` on. Raises CalibrationError as
    `nurbseg.drivers.datasets.beside.find_cameras` does, and RecordingFormatError if the depth is implausible
    in a unit that nobody stated.
    """
    samples = []
    for place in sorted({len(pairs) * part // _SAMPLES for part in range(_SAMPLES)}):
        # A damaged one is named when its frame is read.
        with suppress(FrameFormatError):
            depth = pairs[place].depth
            samples.append(decode_stored(_content(depth), str(depth)))
    size = (samples[0].shape[1], samples[0].shape[0]) if samples else None
    cameras = find_cameras(folder, options, size)
    if options.depth_scale is not None or cameras.depth_unit is not None:
        unit = decided_unit(options.depth_scale, cameras.depth_unit, MILLIMETERS)
        units = ImageUnits(unit, unit)
    else:
        units = ImageUnits(layout or MILLIMETERS)
    units.check(samples, str(folder))
    moments = moments_ns or [(first + number) * FRAME_INTERVAL_NS for number in range(len(pairs))]
    return [
        Shot(pair, cameras, units, moment, pose_file(pair.depth))
        for pair, moment in zip(pairs, moments, strict=True)
    ]


def _content(path: Path) -> bytes:
    return read_file(path, FRAME_BYTES_MAX, what="image", error=FrameFormatError)


def _size(size: Size) -> str:
    return "x".join(map(str, size))
