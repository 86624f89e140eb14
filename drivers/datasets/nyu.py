"""The NYU Depth v2 data set as a source of labeled frames.

Reads the labeled set as it is distributed (``nyu_depth_v2_labeled.mat``, HDF5, read frame by frame)
and single frames in MATLAB 5 files, which have a ``data`` structure with ``rgb`` and ``realDepth``.
"""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import (
    BackendMissingError,
    CalibrationError,
    FrameFormatError,
    RecordingFormatError,
    quoted,
)
from nurbseg.common.files import read_file, visible
from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.common.limits import FRAME_BYTES_MAX
from nurbseg.common.process.channel import Channel, ChannelClosedError
from nurbseg.common.process.child import ChildProcess, exit_description
from nurbseg.drivers.datasets import mat_program
from nurbseg.drivers.datasets.images import decode_labels
from nurbseg.drivers.datasets.sequence import SequenceSource, natural_key
from nurbseg.drivers.depth_unit import DepthUnit, decided_unit
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FRAME_INTERVAL_NS

_log = logging.getLogger(__name__)

#: The color camera to which the labeled set's depth is registered, as its toolbox gives it.
NYU_COLOR_CAMERA = Intrinsics(
    width=640, height=480, fx=518.857901, fy=519.469611, cx=325.582449, cy=253.736166
)
_METRES = DepthUnit(1.0, "NYU Depth v2's own")
#: Largest number of colors from 0 to 1.
_COLOR_MOST = 2.0
#: Longest wait for an answer, seconds; the first comes after the libraries are loaded.
_ANSWER_S = 60.0
#: Largest class of the 13-class labels; each class takes a pass over the image.
_CLASS_MOST = 13
#: A process whose channel is closed ends within this time, seconds.
_END_S = 5.0


class MatReader:
    """Calls `mat_program` in a process, started on first use, and again after a file that crashed it."""

    def __init__(self) -> None:
        self._running: tuple[ChildProcess, Channel] | None = None

    def read(self, function: Callable[..., dict[str, Any]], path: Path, *more: int) -> dict[str, Any]:
        """Return what one of the program's functions reads of a file.

        Raises FrameFormatError if the file cannot be used, or has ended the process; BackendMissingError if a
        library that it needs is not installed.
        """
        if self._running is None:
            child = ChildProcess("nurbseg.drivers.datasets.mat_program", slots=1)
            self._running = child, child.connect(mat_program.CODEC)
        child, channel = self._running
        words = (str(path.absolute()), *more)
        try:
            found: dict[str, Any] = channel.call(function.__name__, *words, limit_s=_ANSWER_S)
        except (FrameFormatError, BackendMissingError) as err:
            raise type(err)(f"{path}: {quoted(str(err))[1:-1]}") from err
        except ChannelClosedError:
            how = exit_description(child.end(_END_S))
            self.close()
            raise FrameFormatError(f"{path}: cannot be read: the process that reads it {how}") from None
        except TimeoutError as err:
            self.close()
            raise FrameFormatError(f"{path}: cannot be read: {err}") from None
        return found

    def close(self) -> None:
        """End the process; safe to call twice."""
        running, self._running = self._running, None
        if running is not None:
            running[0].close()


def _regions(labels: NDArray[np.integer[Any]], instances: NDArray[np.integer[Any]]) -> NDArray[np.uint16]:
    """Give each pair of class and instance a number from 1; 0 stays "not labeled"."""
    pairs = labels.astype(np.int64) * 65536 + instances
    pairs[labels == 0] = 0
    values, numbered = np.unique(pairs, return_inverse=True)
    numbered = numbered.reshape(labels.shape)
    return (numbered + (0 if values[0] == 0 else 1)).astype(np.uint16)


def _calibration(options: SourceOptions, width: int, height: int) -> Calibration:
    """Return what the user gives for images of this size, else the data set's own."""
    given = None if options.calibration is None else options.given_cameras()
    if given is not None:
        return given.calibration(depth_size=(width, height), color_size=(width, height))
    return Calibration.registered(NYU_COLOR_CAMERA.scaled_to(width, height))


class NyuLabelledSource(SequenceSource):
    """``nyu_depth_v2_labeled.mat``: 1449 frames [1]_, of which one at a time is in memory.

    The ground truth of a frame has a region for each pair of class and instance. A calibration in `options`
    takes the place of the data set's own; intrinsics are for images that have none. Raises
    BackendMissingError if h5py is not installed, CalibrationError if the calibration does not fit the images,
    and RecordingFormatError if the file lacks one of the sets ``images``, ``depths``, ``labels`` and
    ``instances``, or their shapes disagree.

    References
    ----------
    .. [1] N. Silberman, D. Hoiem, P. Kohli, R. Fergus, "Indoor segmentation and support inference from
       RGBD images", ECCV 2012.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        self._reader = MatReader()
        with closed_on_error(self._reader.close):
            try:
                frames, width, height = self._reader.read(mat_program.labelled_shape, path)["shape"]
            except FrameFormatError as err:
                raise RecordingFormatError(str(err)) from err
            super().__init__(path, frames, "NYU Depth v2, labeled")
            self._unit = self._state_depth_unit(decided_unit(options.depth_scale, None, _METRES))
            self.calibration = _calibration(options, width, height)

    def _load(self, index: int) -> RGBDFrame:
        sets = self._reader.read(mat_program.labelled_frame, self._path, index)
        color, depth_m, labels, instances = (sets[name] for name in mat_program.SETS)
        # MATLAB stores by columns: HDF5 shows every image transposed.
        return RGBDFrame(
            index=index,
            timestamp_ns=index * FRAME_INTERVAL_NS,
            depth_mm=self._unit.millimeters(depth_m.T),
            color=np.ascontiguousarray(color.transpose(2, 1, 0), dtype=np.uint8),
            calibration=self.calibration,
            labels=_regions(labels.T, instances.T),
            name=f"{index + 1:04d}",
        )

    def _close(self) -> None:
        self._reader.close()


class NyuFrameSource(SequenceSource):
    """Single NYU Depth v2 frames in MATLAB 5 files, with 13-class labels beside them where present.

    `path` is one file, or a folder with files ``nyu_v2_N.mat``, which are played in the order of their
    numbers. Labels are taken from ``new_nyu_class13_NNNN.png`` beside ``nyu_v2_N.mat`` and sampled at the
    nearest pixel where they are larger than the frame. Connected parts of a class are one region each, since
    a class does not distinguish one chair from the next. `options` count as for `NyuLabelledSource`. Raises
    RecordingFormatError if no file has usable ``data.rgb`` and ``data.realDepth``.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        self._paths = [path]
        if path.is_dir():
            self._paths = sorted(visible(path, "nyu_v2_*.mat"), key=lambda file: natural_key(file.name))
        super().__init__(path, len(self._paths), "NYU Depth v2, single frames")
        self._unit = self._state_depth_unit(decided_unit(options.depth_scale, None, _METRES))
        self._options = options
        self._reader = MatReader()
        with closed_on_error(self._reader.close):
            self.calibration = self._first().calibration

    def _load(self, index: int) -> RGBDFrame:
        path = self._paths[index]
        try:
            record = self._reader.read(mat_program.single_frame, path)
        except FrameFormatError as err:
            raise FrameFormatError(f"{err}; expected a structure 'data' with 'rgb' and 'realDepth'") from err
        color, depth_m = record["rgb"], record["realDepth"]
        if depth_m.ndim != 2 or color.shape != (*depth_m.shape, 3):
            raise FrameFormatError(
                f"{path}: data.rgb: expected {(*depth_m.shape, 3)} as for realDepth, got {color.shape}"
            )
        height, width = depth_m.shape
        # Colors from 0 to 1 were resampled, and overshoot a little. Other programs keep them from 0 to 255.
        scale = 255.0 if color.dtype.kind == "f" and color.max(initial=0.0) <= _COLOR_MOST else 1.0
        try:
            calibration = _calibration(self._options, width, height)
        except CalibrationError as err:
            raise FrameFormatError(f"{path}: {err}") from err
        return RGBDFrame(
            index=index,
            timestamp_ns=index * FRAME_INTERVAL_NS,
            depth_mm=self._unit.millimeters(depth_m),
            color=np.ascontiguousarray(np.rint(np.clip(color * scale, 0.0, 255.0)).astype(np.uint8)),
            calibration=calibration,
            labels=self._labels(path, width, height),
            name=path.stem,
        )

    def _labels(self, path: Path, width: int, height: int) -> NDArray[np.uint16] | None:
        try:
            return _class_regions(path, width, height)
        except FrameFormatError as err:
            # A frame can be segmented without.
            _log.warning("%s; the frame has no labels", err)
            return None

    def _close(self) -> None:
        self._reader.close()


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
    if classes.max(initial=0) > _CLASS_MOST:
        raise FrameFormatError(
            f"{labels_path}: expected classes from 0 to {_CLASS_MOST}, got {classes.max()}"
        )
    regions = np.zeros((height, width), np.uint16)
    count = 0
    for value in np.unique(classes[classes > 0]):
        parts, components = cv2.connectedComponents((classes == value).astype(np.uint8), connectivity=4)
        inside = components > 0
        regions[inside] = components[inside] + count
        count += parts - 1
    return regions
