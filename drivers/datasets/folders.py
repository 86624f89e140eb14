"""Folders of image pairs: a color and a depth image for each frame, perhaps with ground truth."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.calibration.file import read_camera_file
from nurbseg.drivers.datasets.images import decode_color, decode_depth, decode_labels
from nurbseg.drivers.datasets.pairs import NAMES_EXPECTED, ImagePair, find_pairs
from nurbseg.drivers.datasets.sequence import FRAME_INTERVAL_NS, SequenceSource
from nurbseg.drivers.errors import CalibrationError, FrameFormatError, RecordingFormatError
from nurbseg.drivers.files import read_file
from nurbseg.drivers.frame import Calibration, RGBDFrame
from nurbseg.drivers.limits import FRAME_BYTES_MAX, STAMP_END_NS

if TYPE_CHECKING:
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
_DEFAULT_UNITS_PER_METRE = 1000.0
#: frame_20121214T142255.814212: the moment in UTC, to the microsecond.
_MOMENT = re.compile(r"(\d{8}T\d{6}\.\d{1,6})")


@dataclass(frozen=True, slots=True, eq=False)
class FolderCamera:
    """The calibration and depth scale that a folder's images are read with.

    Parameters
    ----------
    camera : CameraFile
        Both cameras; sizes may be open.
    units_per_metre : float
        Of 16-bit depth images.
    origin : str
        Where the calibration came from, for a person.
    """

    camera: CameraFile
    units_per_metre: float
    origin: str


def folder_camera(
    folder: Path, options: SourceOptions, default_units_per_metre: float = _DEFAULT_UNITS_PER_METRE
) -> FolderCamera:
    """Return how to read a folder's images: the user's word, else a calibration file in it.

    The files looked for are, in this order, ``camera.toml``, OpenCV's ``calib*.xml|yml|yaml``, ROS's
    ``camera_info.yaml``, ``intrinsics.txt`` and ``camera-intrinsics.txt``.

    Raises
    ------
    CalibrationError
        If there is none, or it is unusable.
    """
    camera, origin = options.given_cameras(), "given"
    if camera is None:
        path = next((p for pattern in _CALIBRATION_PATTERNS for p in sorted(folder.glob(pattern))), None)
        if path is None:
            raise CalibrationError(
                f"{folder}: no calibration: add camera.toml or intrinsics.txt, "
                "or give --intrinsics fx,fy,cx,cy (pixels)"
            )
        camera, origin = read_camera_file(path), path.name
    scale = options.depth_scale or camera.depth_scale or default_units_per_metre
    return FolderCamera(camera=camera, units_per_metre=scale, origin=origin)


def load_pair(pair: ImagePair, reading: FolderCamera, index: int, timestamp_ns: int) -> RGBDFrame:
    """Load the images of one frame.

    Raises
    ------
    FrameFormatError
        If an image is missing or damaged, or has not the form or size that it must have.
    """
    color = decode_color(_content(pair.color), str(pair.color))
    depth_mm = decode_depth(_content(pair.depth), str(pair.depth), units_per_metre=reading.units_per_metre)
    try:
        calibration = reading.camera.calibration(
            depth_size=(depth_mm.shape[1], depth_mm.shape[0]), color_size=(color.shape[1], color.shape[0])
        )
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
        timestamp_ns=timestamp_ns,
        depth_mm=depth_mm,
        color=color,
        calibration=calibration,
        labels=labels,
        name=pair.name or pair.color.stem,
    )


def first_calibration(pair: Callable[[int], ImagePair], frames: int, reading: FolderCamera) -> Calibration:
    """Return the calibration of the first of so many frames that can be loaded.

    Raises
    ------
    RecordingFormatError
        If none can; says what is wrong with the first.
    """
    first: FrameFormatError | None = None
    for index in range(frames):
        try:
            return load_pair(pair(index), reading, 0, 0).calibration
        except FrameFormatError as err:
            first = first or err
    raise RecordingFormatError(f"none of the {frames} frames can be used; the first: {first}") from first


class FolderSource(SequenceSource):
    """Replays a folder of image pairs in the natural order of their names.

    Depth is in millimetres unless the folder or the user says otherwise. A calibration of one camera
    (intrinsics.txt and the like) stands for both images, which are taken to be registered. Images of
    other sizes than calibrated are right where they have the same shape: the intrinsics are scaled. Time
    is taken from names like ``frame_20121214T142255.814212``, else frames are 1/30 s apart.

    Parameters
    ----------
    folder : Path
        Holds the images, and the calibration unless `options` do.
    options : SourceOptions
        Intrinsics and depth scale that the user gives.

    Raises
    ------
    RecordingFormatError
        If there is no pair, or none that can be used.
    CalibrationError
        If there is no calibration, or an unusable one.
    """

    def __init__(self, folder: Path, options: SourceOptions) -> None:
        self._pairs, single = find_pairs(folder)
        if not self._pairs:
            alone = f" ({len(single)} images lack their partner)" if single else ""
            raise RecordingFormatError(f"{folder}: no image pairs{alone}; expected {NAMES_EXPECTED}")
        self._reading = folder_camera(folder, options)
        super().__init__(folder, len(self._pairs), dropped=len(single))
        self.calibration = first_calibration(self._pairs.__getitem__, len(self._pairs), self._reading)
        moments = [_moment_ns(pair.name) for pair in self._pairs]
        timed = all(moment is not None for moment in moments)
        self._moments_ns = [
            moment if timed and moment is not None else index * FRAME_INTERVAL_NS
            for index, moment in enumerate(moments)
        ]
        self.metadata = {
            "format": "folder of image pairs",
            "frames": str(len(self._pairs)),
            "dropped": str(self.dropped),
            "calibration": self._reading.origin,
        }

    def _load(self, index: int) -> RGBDFrame:
        return load_pair(self._pairs[index], self._reading, index, self._moments_ns[index])


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
