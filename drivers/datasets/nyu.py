"""The NYU Depth v2 data set as a source of labelled frames.

Reads the labelled set as it is distributed (``nyu_depth_v2_labeled.mat``, HDF5, read frame by frame)
and single frames in MATLAB 5 files, which have a ``data`` structure with ``rgb`` and ``realDepth``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.datasets.images import decode_labels
from nurbseg.drivers.datasets.mat_process import MatProcess
from nurbseg.drivers.datasets.mat_program import SETS
from nurbseg.drivers.datasets.sequence import FRAME_INTERVAL_NS, SequenceSource
from nurbseg.drivers.errors import CalibrationError, FrameFormatError, RecordingFormatError
from nurbseg.drivers.files import open_regular, read_file
from nurbseg.drivers.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.drivers.limits import FRAME_BYTES_MAX
from nurbseg.drivers.source import FrameSource

if TYPE_CHECKING:
    from nurbseg.drivers.calibration.cameras import CameraFile
    from nurbseg.drivers.options import SourceOptions

#: The color camera to which the labelled set's depth is registered, as its toolbox gives it.
NYU_COLOR_CAMERA = Intrinsics(
    width=640, height=480, fx=518.857901, fy=519.469611, cx=325.582449, cy=253.736166
)

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_MATLAB5_MAGIC = b"MATLAB 5.0 MAT-file"
#: MATLAB writes its own 512 bytes before the HDF5 signature.
_HDF5_OFFSETS = (0, 512)


def is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, as MATLAB 7.3 writes it."""
    with open_regular(path) as stream:
        head = stream.read(_HDF5_OFFSETS[-1] + len(HDF5_MAGIC))
    return any(head[offset : offset + len(HDF5_MAGIC)] == HDF5_MAGIC for offset in _HDF5_OFFSETS)


def is_matlab5(path: Path) -> bool:
    """Whether a file is a MATLAB 5 container."""
    with open_regular(path) as stream:
        return stream.read(len(_MATLAB5_MAGIC)) == _MATLAB5_MAGIC


def depth_to_mm(depth_m: NDArray[np.floating[Any]]) -> NDArray[np.uint16]:
    """Turn metres into the sensor's millimetres; what is no distance becomes 0.

    Parameters
    ----------
    depth_m : (H, W) floating
        Depth, metres; not finite or not positive where there is none.

    Returns
    -------
    (H, W) uint16
        Depth, millimetres; 0 where there is none.
    """
    with np.errstate(over="ignore"):
        depth_mm = np.rint(np.nan_to_num(depth_m, nan=0.0, posinf=0.0, neginf=0.0) * 1000.0)
    depth_mm[(depth_mm < 1) | (depth_mm > 65535)] = 0
    depth: NDArray[np.uint16] = depth_mm.astype(np.uint16)
    return depth


def _regions(labels: NDArray[np.integer[Any]], instances: NDArray[np.integer[Any]]) -> NDArray[np.uint16]:
    """Give each pair of class and instance a number from 1; 0 stays "not labelled"."""
    pairs = labels.astype(np.int64) * 65536 + instances
    pairs[labels == 0] = 0
    values, numbered = np.unique(pairs, return_inverse=True)
    numbered = numbered.reshape(labels.shape)
    return (numbered + (0 if values[0] == 0 else 1)).astype(np.uint16)


def _calibration(given: CameraFile | None, width: int, height: int) -> Calibration:
    """Return what the user gives for images of this size, else the data set's own."""
    if given is not None:
        return given.calibration(depth_size=(width, height), color_size=(width, height))
    return Calibration.registered(NYU_COLOR_CAMERA.scaled_to(width, height))


class NyuLabelledSource(SequenceSource):
    """``nyu_depth_v2_labeled.mat``: 1449 frames, of which one at a time is in memory.

    The ground truth of a frame has a region for each pair of class and instance.

    Parameters
    ----------
    path : Path
        The HDF5 file.
    given : CameraFile, optional
        The user's calibration, in place of the data set's own.

    Raises
    ------
    BackendMissingError
        If h5py is not installed.
    CalibrationError
        If `given` does not fit the images.
    RecordingFormatError
        If the file lacks one of the sets ``images``, ``depths``, ``labels`` and ``instances``, or their
        shapes disagree.

    References
    ----------
    .. [1] N. Silberman, D. Hoiem, P. Kohli, R. Fergus, "Indoor segmentation and support inference from
       RGBD images", ECCV 2012.
    """

    def __init__(self, path: Path, given: CameraFile | None = None) -> None:
        self._process = MatProcess()
        try:
            shapes = {name: tuple(shape) for name, shape in self._answer(path)["shapes"].items()}
            if len(shapes["depths"]) != 3 or not all(shapes["depths"]):
                raise RecordingFormatError(
                    f"{path}: depths: expected (frames, columns, rows), got {shapes['depths']}"
                )
            frames, width, height = shapes["depths"]
            flat = frames, width, height
            for name, shape in (
                ("images", (frames, 3, width, height)),
                ("labels", flat),
                ("instances", flat),
            ):
                if shapes[name] != shape:
                    raise RecordingFormatError(
                        f"{path}: {name}: expected {shape} as for depths, got {shapes[name]}"
                    )
            calibration = _calibration(given, width, height)
        except BaseException:
            self._process.close()
            raise
        super().__init__(path, frames)
        self.calibration = calibration
        self.metadata = {"format": "NYU Depth v2, labelled", "frames": str(frames)}

    def _answer(self, path: Path) -> dict[str, Any]:
        try:
            return self._process.read(path, "hdf5")[0]
        except FrameFormatError as err:
            raise RecordingFormatError(str(err)) from err

    def _load(self, index: int) -> RGBDFrame:
        sets = self._process.read(self._path, "hdf5", index)[1]
        color, depth_m, labels, instances = (sets[name] for name in SETS)
        # MATLAB stores by columns: HDF5 shows every image transposed.
        return RGBDFrame(
            index=index,
            timestamp_ns=index * FRAME_INTERVAL_NS,
            depth_mm=depth_to_mm(depth_m.T),
            color=np.ascontiguousarray(color.transpose(2, 1, 0), dtype=np.uint8),
            calibration=self.calibration,
            labels=_regions(labels.T, instances.T),
            name=f"{index + 1:04d}",
        )

    def _close(self) -> None:
        self._process.close()


class NyuFrameSource(SequenceSource):
    """Single NYU Depth v2 frames in MATLAB 5 files, with 13-class labels beside them where present.

    Labels are taken from ``new_nyu_class13_NNNN.png`` beside ``nyu_v2_N.mat`` and sampled at the nearest
    pixel where they are larger than the frame. Connected parts of a class are one region each, since
    classes do not tell one chair from the next.

    Parameters
    ----------
    paths : sequence of Path
        The files, in the order in which they are played.
    given : CameraFile, optional
        The user's calibration, in place of the data set's own.

    Raises
    ------
    RecordingFormatError
        If `paths` is empty or no file has usable ``data.rgb`` and ``data.realDepth``.
    """

    def __init__(self, paths: list[Path], given: CameraFile | None = None) -> None:
        if not paths:
            raise RecordingFormatError("no NYU Depth v2 frame (nyu_v2_N.mat) in the folder")
        super().__init__(paths[0].parent, len(paths))
        self._paths = paths
        self._given = given
        self._process = MatProcess()
        try:
            self.calibration = self._first_calibration()
        except BaseException:
            self._process.close()
            raise
        self.metadata = {"format": "NYU Depth v2, single frames", "frames": str(len(paths))}

    def _first_calibration(self) -> Calibration:
        first_error = None
        for index in range(len(self._paths)):
            try:
                return self._load(index).calibration
            except FrameFormatError as err:
                first_error = first_error or err
        raise RecordingFormatError(
            f"none of the {len(self._paths)} frames can be used; the first: {first_error}"
        ) from first_error

    def _load(self, index: int) -> RGBDFrame:
        path = self._paths[index]
        try:
            record = self._process.read(path, "matlab5")[1]
        except FrameFormatError as err:
            raise FrameFormatError(f"{err}; expected a structure 'data' with 'rgb' and 'realDepth'") from err
        color, depth_m = record["rgb"], record["realDepth"]
        if depth_m.ndim != 2 or color.shape != (*depth_m.shape, 3):
            raise FrameFormatError(
                f"{path}: data.rgb: expected {(*depth_m.shape, 3)} as for realDepth, got {color.shape}"
            )
        height, width = depth_m.shape
        try:
            calibration = _calibration(self._given, width, height)
        except CalibrationError as err:
            raise FrameFormatError(f"{path}: {err}") from err
        return RGBDFrame(
            index=index,
            timestamp_ns=index * FRAME_INTERVAL_NS,
            depth_mm=depth_to_mm(depth_m),
            color=np.ascontiguousarray(np.rint(np.clip(color, 0.0, 1.0) * 255.0).astype(np.uint8)),
            calibration=calibration,
            labels=_class_regions(path, width, height),
            name=path.stem,
        )

    def _close(self) -> None:
        self._process.close()


def _class_regions(path: Path, width: int, height: int) -> NDArray[np.uint16] | None:
    number = path.stem.rpartition("_")[2]
    if not number.isdecimal():
        return None
    labels_path = path.with_name(f"new_nyu_class13_{int(number):04d}.png")
    if not labels_path.exists():
        return None
    content = read_file(labels_path, FRAME_BYTES_MAX, what="image", error=FrameFormatError)
    classes = cv2.resize(
        decode_labels(content, str(labels_path)), (width, height), interpolation=cv2.INTER_NEAREST
    )
    regions = np.zeros((height, width), np.uint16)
    count = 0
    for value in np.unique(classes[classes > 0]):
        parts, components = cv2.connectedComponents((classes == value).astype(np.uint8), connectivity=4)
        inside = components > 0
        regions[inside] = components[inside] + count
        count += parts - 1
    return regions


def open_path(path: Path, options: SourceOptions | None = None) -> FrameSource:
    """Open the labelled set, one frame, or a folder of single frames.

    Of the options a calibration takes the place of the set's own; intrinsics are for images that have none.

    Raises
    ------
    RecordingFormatError
        If `path` is none of these.
    """
    given = None if options is None or options.calibration is None else options.given_cameras()
    if path.is_dir():
        return NyuFrameSource(sorted(path.glob("nyu_v2_*.mat"), key=_frame_number), given)
    if is_hdf5(path):
        return NyuLabelledSource(path, given)
    if is_matlab5(path):
        return NyuFrameSource([path], given)
    raise RecordingFormatError(f"{path}: expected a MATLAB file of NYU Depth v2")


def _frame_number(path: Path) -> tuple[int, str]:
    number = path.stem.rpartition("_")[2]
    return (int(number) if number.isdecimal() else 0, path.name)
