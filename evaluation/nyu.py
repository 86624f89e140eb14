"""The NYU Depth v2 data set [1]_ as a source of labeled frames: ``nyu:PATH``.

`PATH` is the labeled set as it is distributed (``nyu_depth_v2_labeled.mat``, read by h5py frame by frame),
one frame in a MATLAB 5 file, or a folder of files ``nyu_v2_N.mat``.

References
----------
.. [1] N. Silberman, D. Hoiem, P. Kohli, R. Fergus, "Indoor segmentation and support inference from RGBD
   images", ECCV 2012.
"""

from abc import abstractmethod
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import DeviceNotFoundError, FrameFormatError, RecordingFormatError
from nurbseg.common.files import open_regular, read_file, visible
from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.common.limits import FRAME_BYTES_MAX
from nurbseg.drivers.datasets.images import decode_labels
from nurbseg.drivers.datasets.sequence import SequenceSource, natural_key
from nurbseg.drivers.depth_unit import DepthUnit, decided_unit
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FRAME_INTERVAL_NS

#: The color camera to which the labeled set's depth is registered, as its toolbox gives it.
NYU_COLOR_CAMERA = Intrinsics(
    width=640, height=480, fx=518.857901, fy=519.469611, cx=325.582449, cy=253.736166
)
_UNIT = DepthUnit(1.0, "NYU Depth v2's own")


def open_nyu(rest: str, options: SourceOptions) -> "NyuSource":
    """Open what follows ``nyu:``; a calibration in `options` takes the place of the data set's own.

    Raises DeviceNotFoundError if there is no such path, and RecordingFormatError if it has no frame that can
    be used.
    """
    path = Path(rest)
    if not path.exists():
        raise DeviceNotFoundError(f"{path}: no such file or folder")
    if path.is_file():
        with open_regular(path) as stream:
            if not stream.read(10).startswith(b"MATLAB 5.0"):
                return NyuLabeled(path, options)
    return NyuFrames(path, options)


class NyuSource(SequenceSource):
    """Frames as arrays; subclasses fill in `_arrays`."""

    def __init__(self, path: Path, frames: int, form: str, options: SourceOptions) -> None:
        super().__init__(path, frames, form)
        self._options = options
        self._unit = self._state_depth_unit(decided_unit(options.depth_scale, None, _UNIT))
        self.calibration = self._first().calibration

    def _where(self, index: int) -> str:
        return f"{self._path}: frame {index}"

    @abstractmethod
    def _arrays(self, index: int) -> tuple[str, NDArray[Any], NDArray[Any], NDArray[np.uint16] | None]:
        """Return the name, (H, W, 3) uint8 color, (H, W) depth in meters and (H, W) regions of a frame."""

    def _load(self, index: int) -> RGBDFrame:
        try:
            name, color, depth_m, labels = self._arrays(index)
            size = depth_m.shape[1], depth_m.shape[0]
            given = None if self._options.calibration is None else self._options.given_cameras()
            return RGBDFrame(
                index=index,
                timestamp_ns=index * FRAME_INTERVAL_NS,
                depth_mm=self._unit.millimeters(depth_m),
                color=np.ascontiguousarray(color),
                calibration=Calibration.registered(NYU_COLOR_CAMERA.scaled_to(*size))
                if given is None
                else given.calibration(depth_size=size, color_size=size),
                labels=labels,
                name=name,
            )
        except FrameFormatError:
            raise
        # The libraries raise whatever a damaged file leads them to.
        except Exception as err:
            raise FrameFormatError(f"{self._where(index)}: {type(err).__name__}: {err}") from err


class NyuLabeled(NyuSource):
    """``nyu_depth_v2_labeled.mat``: 1449 frames, whose regions are the pairs of class and instance."""

    def __init__(self, path: Path, options: SourceOptions) -> None:
        import h5py

        try:
            self._file = h5py.File(path, "r")
            self._sets = [self._file[name] for name in ("images", "depths", "labels", "instances")]
            frames, width, height = self._sets[1].shape
            if any(each.shape != (frames, width, height) for each in self._sets[2:]):
                raise ValueError("labels and instances differ in shape from depths")
        except (OSError, KeyError, ValueError, AttributeError) as err:
            raise RecordingFormatError(f"{path}: not the labeled set of NYU Depth v2 ({err})") from err
        super().__init__(path, frames, "NYU Depth v2, labeled", options)

    def _arrays(self, index: int) -> tuple[str, NDArray[Any], NDArray[Any], NDArray[np.uint16] | None]:
        color, depth_m, classes, instances = (each[index] for each in self._sets)
        pairs = np.where(classes == 0, 0, classes.astype(np.int64) * 65536 + instances).T
        values, numbered = np.unique(pairs, return_inverse=True)
        # 0 stays "not labeled".
        regions = numbered.reshape(pairs.shape) + (values[0] != 0)
        # MATLAB stores by columns: HDF5 shows every image transposed.
        return f"{index + 1:04d}", color.transpose(2, 1, 0), depth_m.T, regions.astype(np.uint16)

    def _close(self) -> None:
        self._file.close()


class NyuFrames(NyuSource):
    """Frames with ``data.rgb`` and ``data.realDepth``, whose regions are the connected parts of 13 classes.

    The classes of ``nyu_v2_N.mat`` are those of the nearest pixels of ``new_nyu_class13_NNNN.png`` beside it.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        found = visible(path, "nyu_v2_*.mat") if path.is_dir() else [path]
        self._paths = sorted(found, key=lambda file: natural_key(file.name))
        if not self._paths:
            raise RecordingFormatError(f"{path}: holds no nyu_v2_N.mat")
        super().__init__(path, len(self._paths), "NYU Depth v2, single frames", options)

    def _where(self, index: int) -> str:
        return str(self._paths[index])

    def _arrays(self, index: int) -> tuple[str, NDArray[Any], NDArray[Any], NDArray[np.uint16] | None]:
        import scipy.io

        path = self._paths[index]
        record = scipy.io.loadmat(path, variable_names=["data"])["data"][0, 0]
        color, depth_m = record["rgb"], record["realDepth"]
        # Colors from 0 to 1 were resampled, and overshoot a little.
        scaled = color * 255.0 if color.dtype.kind == "f" and color.max() <= 2.0 else color
        color = np.rint(np.clip(scaled, 0.0, 255.0)).astype(np.uint8)
        number = path.stem.rpartition("_")[2]
        labels = path.with_name(f"new_nyu_class13_{number:0>4}.png")
        regions = _parts(labels, (depth_m.shape[1], depth_m.shape[0])) if labels.exists() else None
        return path.stem, color, depth_m, regions


def _parts(path: Path, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Return the connected parts of the classes in an image, (H, W), numbered from 1."""
    content = read_file(path, FRAME_BYTES_MAX, what="image", error=FrameFormatError)
    classes = cv2.resize(decode_labels(content, str(path)), size, interpolation=cv2.INTER_NEAREST)
    regions = np.zeros(classes.shape, np.uint16)
    for value in np.unique(classes[classes > 0]):
        _, components = cv2.connectedComponents((classes == value).astype(np.uint8), connectivity=4)
        inside = components > 0
        regions[inside] = components[inside] + regions.max()
    return regions
