"""One stream of an opened device: its modes, its settings and its images."""

import ctypes
from enum import IntEnum
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import DeviceLostError, DriverError, FrameFormatError
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.drivers.live.paired_camera import Image
from nurbseg.drivers.openni2 import capi
from nurbseg.drivers.openni2.library import Library


class VideoMode(NamedTuple):
    """Size in pixels, frames per second and pixel format of a stream."""

    width: int
    height: int
    fps: int
    pixel_format: capi.PixelFormat

    def __str__(self) -> str:
        return f"{self.width}x{self.height}@{self.fps} {self.pixel_format.name}"


class WithProperties:
    """A device, or one of its streams; `kind` is how the library's functions call it."""

    def __init__(self, library: Library, kind: Literal["Device", "Stream"]) -> None:
        self.library = library
        self.handle = ctypes.c_void_p()
        self._get_property = getattr(library.native, f"oni{kind}GetProperty")
        self._set_property = getattr(library.native, f"oni{kind}SetProperty")

    def find(self, name: IntEnum, kind: type[Any]) -> Any | None:
        """Return a property as a ctypes structure, or as a plain value for a simple type.

        None where it is not reported.
        """
        value, size = kind(), ctypes.c_int(ctypes.sizeof(kind))
        if self._get_property(self.handle, name, ctypes.byref(value), ctypes.byref(size)) != capi.Status.OK:
            return None
        return value.value if isinstance(value, ctypes._SimpleCData) else value

    def set(self, name: IntEnum, value: Any) -> int:
        """Set a property to a ctypes value; return the status."""
        status: int = self._set_property(self.handle, name, ctypes.byref(value), ctypes.sizeof(value))
        return status


class Stream(WithProperties):
    """A stream of one sensor of an opened device; raises DriverError where the device does not give it."""

    def __init__(self, library: Library, device: ctypes.c_void_p, sensor: capi.Sensor) -> None:
        super().__init__(library, "Stream")
        self.sensor = sensor
        info = library.native.oniDeviceGetSensorInfo(device, sensor)
        if not info:
            raise DriverError(f"the camera has no {sensor.name.lower()} stream")
        self.modes = tuple(_mode(info.contents.modes[i]) for i in range(info.contents.mode_count))
        library.check(
            library.native.oniDeviceCreateStream(device, sensor, ctypes.byref(self.handle)),
            f"creating the {sensor.name.lower()} stream",
        )

    @property
    def mode(self) -> VideoMode:
        """The mode that is set; raises DriverError if the stream does not report it."""
        mode = self.find(capi.StreamProperty.VIDEO_MODE, capi.OniVideoMode)
        if mode is None:
            raise DriverError(f"the {self.sensor.name.lower()} stream does not report its mode")
        return _mode(mode)

    @property
    def horizontal_fov(self) -> float | None:
        """The horizontal field of view, radians; None where the stream does not report it."""
        return self.find(capi.StreamProperty.HORIZONTAL_FOV, ctypes.c_float)

    def set_mode(self, width: int, height: int, fps: int, formats: tuple[capi.PixelFormat, ...]) -> None:
        """Choose a mode from what the device lists; of several formats the first one listed.

        Raises DriverError if the device lists no such mode, or refuses it.
        """
        name = self.sensor.name.lower()
        modes = (VideoMode(width, height, fps, pixel_format) for pixel_format in formats)
        wanted = next((mode for mode in modes if mode in self.modes), None)
        if wanted is None:
            listed = ", ".join(str(mode) for mode in self.modes)
            raise DriverError(
                f"{name} stream: the camera has no {width}x{height}@{fps} as "
                f"{' or '.join(each.name for each in formats)}; it lists {listed or 'nothing'}"
            )
        value = capi.OniVideoMode(wanted.pixel_format, width, height, fps)
        status = self.set(capi.StreamProperty.VIDEO_MODE, value)
        self.library.check(status, f"setting the {name} stream to {wanted}")
        if self.mode != wanted:
            raise DriverError(f"{name} stream: requested {wanted}, but the camera stays at {self.mode}")

    def try_to_set(self, name: capi.StreamProperty, value: Any) -> bool:
        """Set a property and read it back; return whether it has the value now."""
        if self.set(name, value) != capi.Status.OK:
            return False
        wanted = value.value if isinstance(value, ctypes._SimpleCData) else value
        return bool(self.find(name, type(value)) == wanted)

    def start(self) -> None:
        """Start the delivery of frames."""
        self.library.check(
            self.library.native.oniStreamStart(self.handle),
            f"starting the {self.sensor.name.lower()} stream",
        )

    def stop(self) -> None:
        """Stop the delivery of frames."""
        self.library.native.oniStreamStop(self.handle)

    def destroy(self) -> None:
        """Destroy the stream; must be called once."""
        self.library.native.oniStreamDestroy(self.handle)

    def take(self) -> Image | None:
        """Copy the image that is waiting, for a stream that `wait_for_any` has named.

        Depth is uint16 in the mode's unit, color RGB uint8. None where the image is not there any more, as it
        may be when a camera is unplugged. Raises DeviceLostError if the library cannot give it, and
        FrameFormatError if it is not what its mode says.
        """
        frame = ctypes.POINTER(capi.OniFrame)()
        status = self.library.native.oniStreamReadFrame(self.handle, ctypes.byref(frame))
        if status != capi.Status.OK:
            self.library.check(status, f"reading the {self.sensor.name.lower()} stream", DeviceLostError)
        if not frame:
            return None
        try:
            head = frame.contents
            pixel_format = _mode(head.mode).pixel_format
            size = head.stride * head.height
            row_bytes = head.width * capi.BYTES_PER_PIXEL.get(pixel_format, 0)
            if not 0 < row_bytes <= head.stride or not 0 < size <= head.data_size or not head.data:
                raise FrameFormatError(
                    f"{self.sensor.name.lower()} frame {head.frame_index}: {head.width}x{head.height} "
                    f"{pixel_format.name}, {head.stride} bytes a row, does not fit {head.data_size} bytes"
                )
            copy = np.frombuffer(ctypes.string_at(head.data, size), np.uint8)
            rows = copy.reshape(head.height, head.stride)[:, :row_bytes]
            return Image(head.timestamp, head.frame_index, _pixels(rows, pixel_format))
        finally:
            self.library.native.oniFrameRelease(frame)


def _mode(mode: capi.OniVideoMode) -> VideoMode:
    try:
        pixel_format = capi.PixelFormat(mode.pixel_format)
    except ValueError:
        pixel_format = capi.PixelFormat.GRAY16  # a format that is never requested
    return VideoMode(mode.width, mode.height, mode.fps, pixel_format)


def _pixels(rows: NDArray[np.uint8], pixel_format: capi.PixelFormat) -> NDArray[Any]:
    if pixel_format in (capi.PixelFormat.DEPTH_1_MM, capi.PixelFormat.DEPTH_100_UM):
        return rows.view(np.uint16)
    image = rows.reshape(len(rows), -1, capi.BYTES_PER_PIXEL[pixel_format])
    if pixel_format == capi.PixelFormat.RGB888:
        return image
    import cv2  # late: few cameras need it, and starting to read one must be quick

    to_rgb = {
        capi.PixelFormat.YUV422: cv2.COLOR_YUV2RGB_UYVY,
        capi.PixelFormat.YUYV: cv2.COLOR_YUV2RGB_YUY2,
        capi.PixelFormat.GRAY8: cv2.COLOR_GRAY2RGB,
    }
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), to_rgb[pixel_format]), np.uint8)


def frame_of(
    index: int,
    timestamp_us: int,
    depth: NDArray[Any],
    color: NDArray[Any],
    calibration: Calibration,
    *,
    tenths: bool,
    flips: tuple[bool, bool],
) -> RGBDFrame:
    """Return the frame of the images that a device or a recording delivers.

    Depth in tenths of a millimeter is rounded to whole ones; `flips` says if depth and color are mirrored.
    """
    if tenths:
        depth = ((depth.astype(np.uint32) + 5) // 10).astype(np.uint16)
    depth, color = (
        np.ascontiguousarray(image[:, ::-1]) if flip else image
        for image, flip in zip((depth, color), flips, strict=True)
    )
    return RGBDFrame(index, timestamp_us * 1000, depth, color, calibration)


def wait_for_any(library: Library, streams: tuple[Stream, ...], timeout_s: float) -> Stream | None:
    """Return a stream that has an image, or None if none came in time.

    Of several, the one whose image is oldest. A recording that is played step by step advances by one image
    with each call that finds none. Raises DeviceLostError where the library cannot wait.
    """
    handles = (ctypes.c_void_p * len(streams))(*(stream.handle for stream in streams))
    index = ctypes.c_int(-1)
    status = library.native.oniWaitForAnyStream(
        handles, len(streams), ctypes.byref(index), max(0, round(timeout_s * 1000))
    )
    if status == capi.Status.TIME_OUT:
        return None
    library.check(status, "waiting for a frame", DeviceLostError)
    return streams[index.value]
