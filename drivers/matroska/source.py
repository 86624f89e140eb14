"""Replays recordings of k4arecorder, of an Azure Kinect or an Orbbec Femto (``.mkv``)."""

import logging
import os
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import CalibrationError, FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import open_regular
from nurbseg.common.frame import RGBDFrame
from nurbseg.common.limits import FRAME_BYTES_MAX, STAMP_END_NS, TEXT_BYTES_MAX
from nurbseg.common.structured_text import decode_text, parse_json
from nurbseg.drivers.calibration.cameras import CameraFile, image_size
from nurbseg.drivers.datasets.images import GRAY, decode_color
from nurbseg.drivers.datasets.listed.tum import associate
from nurbseg.drivers.datasets.sequence import SequenceSource
from nurbseg.drivers.depth_unit import DepthUnit, decided_unit
from nurbseg.drivers.gravity import gravity_of
from nurbseg.drivers.matroska.kinect_calibration import cameras_of_kinect, depth_from_accelerometer
from nurbseg.drivers.matroska.listing import Listing, Track
from nurbseg.drivers.options import SourceOptions

_log = logging.getLogger(__name__)

#: A depth image and a color image that are farther apart do not belong together, seconds: half of 30 Hz.
_LIMIT_S = 0.017
_MILLIMETRES = DepthUnit(1000.0, "the recorder's own")
_DEPTH_FORMS, _JPEG_FORMS = ("b16g",), ("MJPG", "V_MJPEG")
#: Forms of color that is not compressed: bytes per pixel, rows of bytes per row of pixels, the conversion.
_COLOR_FORMS = {
    "NV12": (1, 1.5, cv2.COLOR_YUV2RGB_NV12),
    "YUY2": (2, 1.0, cv2.COLOR_YUV2RGB_YUY2),
    "BGRA": (4, 1.0, cv2.COLOR_BGRA2RGB),
}
#: Digits of a time in a tag, nanoseconds: more are none.
_OFFSET_DIGITS_MAX = 18
#: A reading as the recorder writes it: accelerometer and gyroscope, each with its time.
_READING = np.dtype([("ns", "<u8"), ("m_s2", "<f4", 3), ("gyro_ns", "<u8"), ("rad_s", "<f4", 3)])
#: Readings of a block are at most so many, since one byte counts them.
_READINGS_MAX = 256
#: A block farther from an image than this says nothing of it, nanoseconds.
_NEAR_NS = 100_000_000


class KinectRecordingSource(SequenceSource):
    """Frames of a recording, at the times of the device's clock.

    Depth is as the camera delivers it, not registered. Without a track of color, it is gray. Images without a
    partner are dropped and counted in ``metadata["dropped"]``. Raises RecordingFormatError if the file is
    damaged, or holds no depth; CalibrationError if it holds no usable calibration, and the user gives none.
    """

    def __init__(self, path: Path, options: SourceOptions) -> None:
        self._stream = open_regular(path)
        with closed_on_error(self._stream.close):
            listing = Listing(path, self._stream)
            depth = _track(path, listing, "depth", _DEPTH_FORMS)
            self._color = _track(path, listing, "color", (*_JPEG_FORMS, *_COLOR_FORMS))
            if depth is None:
                raise RecordingFormatError(
                    f"{path}: cannot be replayed: a Matroska video without depth of k4arecorder, a track "
                    "called DEPTH; export its images as 16-bit PNG"
                )
            self._depth = depth
            limit_s = max(options.association_limit_s, _LIMIT_S)
            self._frames_found, dropped, self._offset_ns = _paired(path, listing, depth, self._color, limit_s)
            super().__init__(path, len(self._frames_found), "k4arecorder's recording")
            self._unit = self._state_depth_unit(decided_unit(options.depth_scale, None, _MILLIMETRES))
            self.metadata["dropped"] = str(dropped)
            if "K4A_DEVICE_SERIAL_NUMBER" in listing.tags:
                self.metadata["serial"] = listing.tags["K4A_DEVICE_SERIAL_NUMBER"]
            color_size = None if self._color is None else self._color.size
            cameras, table = options.given_cameras(), None
            with suppress(CalibrationError) if cameras else nullcontext():
                table = _calibration_table(path, listing)
            if cameras is None:
                cameras = cameras_of_kinect(path, table, depth.size, color_size)
            if self._color is None:
                _log.warning("%s: has no color; the color is gray", path)
                cameras = CameraFile(path=path, depth=cameras.depth, color=cameras.depth)
            self.calibration = cameras.calibration(depth_size=depth.size, color_size=color_size or depth.size)
            self._accelerometer: _Accelerometer | None = None
            motion = next((track for track in listing.tracks.values() if track.name == "imu"), None)
            turn = depth_from_accelerometer(path, table)
            if motion is not None and turn is not None:
                self._accelerometer = _Accelerometer(motion, turn)
            self._first()

    def _load(self, index: int) -> RGBDFrame:
        time_ns, *places = self._frames_found[index].tolist()
        name = f"{self._path}: frame {index}"
        width, height = self._depth.size
        content = self._content(f"{name}: depth", *places[:2])
        if len(content) != 2 * width * height:
            raise FrameFormatError(f"{name}: depth: has {len(content)} bytes, not those of {width}x{height}")
        stored = np.frombuffer(content, ">u2").reshape(height, width).astype(np.uint16)
        if self._color is None:
            color = np.full((height, width, 3), GRAY, np.uint8)
        else:
            color = _rgb(self._content(f"{name}: color", *places[2:]), self._color, f"{name}: color")
        gravity = None
        if self._accelerometer is not None:
            gravity = self._accelerometer.gravity(self._stream, time_ns - self._offset_ns)
        depth_mm = self._unit.millimeters(stored)
        return RGBDFrame(index, time_ns, depth_mm, color, self.calibration, gravity=gravity)

    def _content(self, name: str, start: int, end: int) -> bytes:
        if end - start > FRAME_BYTES_MAX:
            raise FrameFormatError(f"{name}: has {end - start} bytes; expected {FRAME_BYTES_MAX} at most")
        try:
            return os.pread(self._stream.fileno(), end - start, start)
        except OSError as err:
            raise FrameFormatError(f"{name}: cannot be read ({err.strerror})") from err

    def _close(self) -> None:
        self._stream.close()


class _Accelerometer:
    """Finds the direction of gravity at a time.

    The blocks of `track` hold one reading or, laced, several; `depth_from_sensor` turns (3, 3) from the
    accelerometer's axes to those of the depth camera.
    """

    def __init__(self, track: Track, depth_from_sensor: NDArray[np.float64]) -> None:
        self._blocks = track.sorted_blocks()
        self._turn = depth_from_sensor

    def gravity(self, stream: BinaryIO, time_ns: int) -> NDArray[np.float64] | None:
        """Return the direction at a time of the blocks; None where no reading is near and usable."""
        times = self._blocks[:, 0]
        after = int(np.searchsorted(times, time_ns))
        near = [n for n in (after - 1, after) if 0 <= n < times.size]
        near.sort(key=lambda n: abs(int(times[n]) - time_ns))
        if not near or abs(int(times[near[0]]) - time_ns) > _NEAR_NS:
            return None
        start, end = self._blocks[near[0], 1:].tolist()
        content = os.pread(stream.fileno(), min(end - start, 2 * _READINGS_MAX * _READING.itemsize), start)
        # What laces readings together is a few bytes in front of them.
        count = len(content) // _READING.itemsize
        readings = np.frombuffer(content, _READING, count, len(content) - count * _READING.itemsize)
        mean = readings["m_s2"].mean(axis=0, dtype=np.float64) if count else np.zeros(3)
        return gravity_of(mean, self._turn)


def _track(path: Path, listing: Listing, name: str, forms: tuple[str, ...]) -> Track | None:
    """Return the track of that name that has images, checked; None if there is none."""
    found = [track for track in listing.tracks.values() if track.name == name and track.blocks]
    if not found:
        return None
    track, fields = found[0], (f"{name}: width", f"{name}: height")
    if track.form not in forms or track.is_encoded:
        how = "compressed once more" if track.is_encoded else f"of the form {quoted(track.form)}"
        raise RecordingFormatError(
            f"{path}: {name}: is {how}; expected {', '.join(forms)} as k4arecorder writes"
        )
    if image_size(path, fields, track.size) is None:
        raise RecordingFormatError(f"{path}: {fields[0]}: is missing")
    return track


def _paired(
    path: Path, listing: Listing, depth: Track, color: Track | None, limit_s: float
) -> tuple[NDArray[np.int64], int, int]:
    """Return the time of each frame and the places of its images, (N, 5); and how many images are dropped.

    Times are those of the device. They are more than those in the file by the third value, nanoseconds.
    """
    offset_ns, delay_ns = (
        _nanoseconds(listing.tags.get(f"K4A_{name}_NS")) for name in ("START_OFFSET", "DEPTH_DELAY")
    )
    depths = depth.sorted_blocks()
    frames = np.zeros((len(depths), 5), np.int64)
    frames[:, :3] = depths
    dropped = 0
    if color is not None:
        colors = color.sorted_blocks()
        # Where the depth camera is to be late, its images belong to color of before.
        times = (depths[:, 0] - delay_ns).tolist()
        pairs = associate(times, colors[:, 0].tolist(), round(limit_s * 1e9))
        if not pairs:
            raise RecordingFormatError(f"{path}: no depth and color were taken within {limit_s:g} s")
        frames = frames[[d for d, _ in pairs]]
        frames[:, 3:] = colors[[c for _, c in pairs], 1:]
        dropped = len(depths) + len(colors) - 2 * len(pairs)
    if not 0 <= frames[0, 0] + offset_ns <= frames[-1, 0] + offset_ns < STAMP_END_NS:
        offset_ns = 0
    frames[:, 0] += offset_ns
    return frames, dropped, offset_ns


def _nanoseconds(text: str | None) -> int:
    """Return the number in a tag; 0 where it is none."""
    digits = (text or "").removeprefix("-")
    return int(text or 0) if digits.isdecimal() and len(digits) <= _OFFSET_DIGITS_MAX else 0


def _calibration_table(path: Path, listing: Listing) -> Any:
    """Return the calibration that is attached; raises CalibrationError if there is none that can be read."""
    for content in listing.attached:
        if len(content) <= TEXT_BYTES_MAX and b"CalibrationInformation" in content:
            try:
                return parse_json(decode_text(content.rstrip(b"\0")))
            except ValueError as err:
                raise CalibrationError(f"{path}: calibration.json: not valid JSON ({err})") from err
    raise CalibrationError(f"{path}: no calibration.json is attached; give --calibration FILE")


def _rgb(content: bytes, track: Track, name: str) -> NDArray[np.uint8]:
    """Return a color image, (H, W, 3) RGB; raises FrameFormatError, which calls it `name`."""
    width, height = track.size
    if track.form in _JPEG_FORMS:
        color = decode_color(content, name)
    else:
        channels, rows, conversion = _COLOR_FORMS[track.form]
        expected = width * channels * round(height * rows)
        if len(content) != expected or width % 2 or height % 2:
            raise FrameFormatError(
                f"{name}: has {len(content)} bytes, not {expected}, those of {width}x{height}"
            )
        pixels = np.frombuffer(content, np.uint8).reshape(round(height * rows), width, channels)
        color = np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)
    if color.shape[:2] != (height, width):
        raise FrameFormatError(f"{name}: has {color.shape[1]}x{color.shape[0]} pixels, not {width}x{height}")
    return color
