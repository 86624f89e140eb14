"""Replays recordings of the app Record3D (``.r3d``): color, depth and poses in a zip archive."""

import ctypes
import logging
import re
import struct
import zipfile
import zlib
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, BinaryIO

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
from nurbseg.common.files import open_regular
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.common.limits import FRAME_BYTES_MAX, LIST_BYTES_MAX, STAMP_END_NS
from nurbseg.common.structured_text import decode_text, parse_json
from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel, image_size, number
from nurbseg.drivers.datasets.images import decode_color
from nurbseg.drivers.datasets.poses import OPENGL_FROM_OURS
from nurbseg.drivers.datasets.sequence import SequenceSource
from nurbseg.drivers.depth_unit import DepthUnit, decided_unit
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.source import FRAME_INTERVAL_NS

_log = logging.getLogger(__name__)

_METRES = DepthUnit(1.0, "Record3D's own")
_DEPTH_NAME = re.compile(r"rgbd/(\d{1,9})\.depth")
#: The ends of a zip archive, and where they say how large its directory is; and what holds both.
_ZIP_ENDS, _ZIP_TAIL = ((b"PK\x05\x06", "<I", 12), (b"PK\x06\x06", "<Q", 40)), 1 << 17
#: Whatever zipfile raises for an archive that is damaged, encrypted or compressed in another way.
_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    OSError,
    EOFError,
    ValueError,
    RuntimeError,
    NotImplementedError,
)


def is_record3d(path: Path) -> bool:
    """Whether a zip archive is such a recording, by its name or what it holds."""
    if path.suffix.lower() == ".r3d":
        return True
    try:
        with open_regular(path) as stream:
            names = _opened(path, stream).NameToInfo
            return "metadata" in names and "rgbd/0.depth" in names
    except RecordingFormatError:
        return False


class Record3DSource(SequenceSource):
    """Frames of a recording: depth is in color's geometry, but has fewer pixels.

    Poses are those of ARKit, whose world has y up. Raises BackendMissingError if the library for the depth's
    compression is not installed, RecordingFormatError if the archive is damaged or none of its frames can be
    used, and CalibrationError if it states no usable camera, and the user gives none.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        check_installed()
        self._stream = open_regular(path)
        with closed_on_error(self._stream.close):
            self._zip = _opened(path, self._stream)
            matches = (_DEPTH_NAME.fullmatch(name) for name in self._zip.NameToInfo)
            self._numbers = sorted(int(match[1]) for match in matches if match is not None)
            if not self._numbers:
                raise RecordingFormatError(
                    f"{path}: holds no rgbd/0.depth, so it is no recording of Record3D"
                )
            super().__init__(path, len(self._numbers), "Record3D")
            self._unit = self._state_depth_unit(decided_unit(options.depth_scale, _METRES, _METRES))
            stated = self._metadata()
            self._given = options.given_cameras()
            sizes = (("w", "h"), ("dw", "dh"))
            self._color_size, self._depth_size = (
                image_size(path, size, (stated.get(size[0]), stated.get(size[1]))) for size in sizes
            )
            self._cameras = self._table(stated, "perFrameIntrinsicCoeffs", 4)
            self._matrix = stated.get("K")
            self._poses = self._table(stated, "poses", 7)
            self._stamps_ns = self._stamps(stated)
            self.calibration = self._first().calibration

    def _metadata(self) -> dict[str, Any]:
        try:
            stated = parse_json(decode_text(self._content("metadata", LIST_BYTES_MAX)))
            if not isinstance(stated, dict):
                raise ValueError(f"expected a table, got {quoted(stated)}")
        except ValueError as err:
            raise RecordingFormatError(f"{self._path}: metadata: {err}") from err
        return stated

    def _table(self, stated: dict[str, Any], key: str, columns: int) -> NDArray[np.float64]:
        """Return a list of rows of numbers, one a frame, as (N, columns); N is 0 where it is not usable."""
        try:
            table = np.array(stated.get(key) or (), np.float64)
        except (TypeError, ValueError, OverflowError):
            table = np.zeros(1)
        if not table.size:
            return np.zeros((0, columns))
        if table.ndim != 2 or table.shape[1] != columns:
            _log.warning("%s: %s: expected %d numbers for each frame; left out", self._path, key, columns)
            return np.zeros((0, columns))
        return table

    def _stamps(self, stated: dict[str, Any]) -> NDArray[np.int64]:
        """Return the time of each frame, (N,) nanoseconds: as stated, else by the rate, else 1/30 s apart."""
        fps, interval_ns = stated.get("fps"), float(FRAME_INTERVAL_NS)
        if isinstance(fps, int | float) and 1e-3 < fps < 1e4:
            interval_ns = 1e9 / fps
        by_rate = np.array([round(each * interval_ns) for each in self._numbers], np.int64)
        try:
            stamps_s = np.array(stated.get("frameTimestamps") or (), np.float64)[self._numbers]
        except (IndexError, TypeError, ValueError, OverflowError):
            return by_rate
        in_range = np.isfinite(stamps_s) & (stamps_s >= 0) & (stamps_s < STAMP_END_NS * 1e-9)
        if not in_range.all() or (np.diff(stamps_s) <= 0).any():
            _log.warning("%s: frameTimestamps: do not continue; the frame rate counts", self._path)
            return by_rate
        return np.rint(stamps_s * 1e9).astype(np.int64)

    def _load(self, index: int) -> RGBDFrame:
        frame = self._numbers[index]
        color_name, depth_name = f"rgbd/{frame}.jpg", f"rgbd/{frame}.depth"
        color = decode_color(self._content(color_name, FRAME_BYTES_MAX), f"{self._path}: {color_name}")
        color_size = color.shape[1], color.shape[0]
        depth_m = self._depth(depth_name, color_size)
        values = None
        if self._given is None:
            values = tuple(self._cameras[frame]) if frame < len(self._cameras) else self._of_matrix()
        depth_size = depth_m.shape[1], depth_m.shape[0]
        try:
            calibration = _calibration(
                self._given, self._path, values, self._color_size, depth_size, color_size
            )
        except CalibrationError as err:
            raise FrameFormatError(f"frame {frame}: {err}") from err
        return RGBDFrame(
            index=index,
            timestamp_ns=int(self._stamps_ns[index]),
            depth_mm=self._unit.millimeters(depth_m),
            color=color,
            calibration=calibration,
            name=str(frame),
            world_from_camera=self._pose(frame),
        )

    def _depth(self, name: str, color_size: tuple[int, int]) -> NDArray[np.float32]:
        """Return a depth image, (H, W) meters; its size is stated, else it has color's shape."""
        width, height = self._depth_size or color_size
        try:
            values = decompress(self._content(name, FRAME_BYTES_MAX), 4 * width * height)
            if self._depth_size is None:
                part = (values.size / (4 * width * height)) ** 0.5
                width, height = round(part * width), round(part * height)
            if values.size != 4 * width * height:
                raise ValueError(f"expected {width}x{height} values of 4 bytes, got {values.size} bytes")
        except ValueError as err:
            raise FrameFormatError(f"{self._path}: {name}: {err}") from err
        return values.view("<f4").reshape(height, width)

    def _of_matrix(self) -> tuple[float, ...]:
        if not isinstance(self._matrix, list) or len(self._matrix) != 9:
            raise CalibrationError(f"{self._path}: K: expected 9 numbers, got {quoted(self._matrix)}")
        numbers = [number(self._path, "K", value) for value in self._matrix]
        # The app writes it by columns, other programs by rows.
        places = (0, 4, 2, 5) if any(numbers[place] for place in (2, 5)) else (0, 4, 6, 7)
        return tuple(numbers[place] for place in places)

    def _pose(self, frame: int) -> NDArray[np.float64] | None:
        """Return world_from_camera; None where it is not stated, or is none."""
        from scipy.spatial.transform import Rotation  # late: few recordings have poses

        row = self._poses[frame] if frame < len(self._poses) else np.full(7, np.nan)
        if not np.isfinite(row).all() or not 0.9 < np.linalg.norm(row[:4]) < 1.1:
            return None
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(row[:4]).as_matrix(), row[4:]
        return pose @ OPENGL_FROM_OURS

    def _content(self, name: str, most: int) -> bytes:
        """Return a file of the archive; raises FrameFormatError if it is missing, damaged or too large."""
        try:
            entry = self._zip.getinfo(name)
            # Others are decompressed in parts of any size.
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError(f"is compressed by method {entry.compress_type}, not by deflate")
            if entry.file_size > most:
                raise ValueError(f"has {entry.file_size} bytes; expected {most} at most")
            with self._zip.open(entry) as file:
                return file.read(most)
        except KeyError as err:
            raise FrameFormatError(f"{self._path}: {name}: is missing") from err
        except _ZIP_ERRORS as err:
            raise FrameFormatError(f"{self._path}: {name}: {err}") from err

    def _close(self) -> None:
        self._stream.close()


def _opened(path: Path, stream: BinaryIO) -> zipfile.ZipFile:
    """Open an archive; raises RecordingFormatError if it is none, or its directory is too large."""
    try:
        stream.seek(0, 2)
        stream.seek(max(0, stream.tell() - _ZIP_TAIL))
        tail = stream.read(_ZIP_TAIL)
        sizes = [
            struct.unpack_from(form, tail, found + place)[0]
            for magic, form, place in _ZIP_ENDS
            if (found := tail.rfind(magic)) >= 0
        ]
        # All ones: the other one says it.
        size = max((size for size in sizes if size != 0xFFFFFFFF), default=0)
        if size > LIST_BYTES_MAX:
            raise ValueError(f"its directory has {size} bytes; expected {LIST_BYTES_MAX} at most")
        return zipfile.ZipFile(stream)
    except _ZIP_ERRORS as err:
        raise RecordingFormatError(f"{path}: the archive is damaged or cut off ({err})") from err


@lru_cache(maxsize=4)
def _calibration(
    given: CameraFile | None,
    path: Path,
    values: tuple[float, ...] | None,
    size: tuple[int, int] | None,
    depth_size: tuple[int, int],
    color_size: tuple[int, int],
) -> Calibration:
    """Return the calibration of a frame, the same one for all that share it."""
    if given is None:
        assert values is not None
        fx, fy, cx, cy = values
        camera = CameraModel(path, "K", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), size=size)
        given = CameraFile(path=path, depth=camera, color=camera)
    return given.calibration(depth_size=depth_size, color_size=color_size)


_INSTALL = "Record3D's depth is compressed by LZFSE: pip install 'nurbseg[record3d]'"


@cache
def _decoder() -> Any:
    # What the module offers to Python decompresses whatever there is, beginning anew with twice the memory
    # each time it lacks some. Its library's own function fills the memory that it is given.
    try:
        import lzfse

        function = ctypes.CDLL(lzfse.__file__).lzfse_decode_buffer
    except (ImportError, OSError, AttributeError) as err:
        raise BackendMissingError(f"{_INSTALL} ({err})") from err
    function.restype = ctypes.c_size_t
    function.argtypes = [
        ctypes.c_void_p,
        ctypes.c_size_t,
        ctypes.c_char_p,
        ctypes.c_size_t,
        ctypes.c_void_p,
    ]
    return function


def check_installed() -> None:
    """Raise BackendMissingError, which says what to install, if the library is not there."""
    _decoder()


def decompress(content: bytes, most: int) -> NDArray[np.uint8]:
    """Return the (N,) bytes that were compressed; raises ValueError if they are damaged, or over `most`."""
    decompressed = np.empty(most + 1, np.uint8)
    size = _decoder()(decompressed.ctypes.data, decompressed.size, content, len(content), None)
    if size == 0:
        raise ValueError("the LZFSE data are damaged")
    if size > most:
        raise ValueError(f"the LZFSE data hold over {most} bytes")
    return decompressed[:size]
