"""A camera that is read by a process of its own, as a source of frames."""

import contextlib
import logging
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import DeviceLostError, DriverError, FrameFormatError, FrameTimeoutError
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.common.process.channel import ChannelClosedError
from nurbseg.common.process.child import ChildProcess
from nurbseg.common.process.codec import Answer, Call, Codec
from nurbseg.drivers.options import DeviceOptions, parse_mode
from nurbseg.drivers.source import FrameSource

#: What a driver is called, and the class of its cameras.
DRIVERS = {
    "openni2": ("OpenNI2", "openni2.device:DeviceSource"),
    "realsense": ("the RealSense SDK", "realsense.device:RealSenseSource"),
}
#: The process must have opened the camera within this time, seconds.
_OPEN_LIMIT_S = 60.0
#: And must end when it is to.
_END_LIMIT_S = 30.0
#: A process that is silent for this long hangs, seconds; it reports a silent camera itself.
_HANG_LIMIT_S = 10.0
#: Longest single wait for the camera to open, seconds.
_POLL_S = 1.0
#: Frames that may wait, seconds; and some more, as several slots come free at a time.
_DEPTH_S, _MORE = 1.0, 4


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrame:
    """A pair of images, how many were lost until then, and where down is."""

    timestamp_ns: int
    depth_mm: NDArray[np.uint16]
    color: NDArray[np.uint8]
    missed: int
    half_pairs: int
    gravity: NDArray[np.float64] | None


@dataclass(frozen=True, slots=True)
class DamagedImage:
    """What is wrong with an image that was passed over."""

    text: str


CODEC = Codec(CameraFrame, DamagedImage, DeviceOptions, Calibration)


class IsolatedCamera(FrameSource):
    """Frames of a camera, read as `DeviceSource` does, but by another process.

    Up to a second of frames waits here for a reader that comes late; `missed` counts those that the camera
    delivered, but that were too late or too many, and `half_pairs` images whose other half never came within
    `pairing_limit_s`.

    `wanted` is interpreted by `nurbseg.drivers.openni2.selection.choose`. With `patience_s`, the process
    looks for a camera that is not there at this interval, seconds, and the source is usable once `is_open`
    says so. `driver` is a key of `DRIVERS`.

    Raises BackendMissingError if the driver's library is not installed, DeviceNotFoundError if there is no
    such camera or it cannot be opened, CalibrationError if the options name a calibration file that is
    damaged, and DriverError if the camera has no such streams or modes.
    """

    live = True

    def __init__(
        self,
        wanted: str = "any",
        options: DeviceOptions | None = None,
        *,
        pairing_limit_s: float = 0.02,
        patience_s: float | None = None,
        driver: str = "openni2",
    ) -> None:
        super().__init__()
        self.missed = self.half_pairs = 0
        self._index = self._refused = 0
        self._begun = self._is_open = False
        self._driver_name = DRIVERS[driver][0]
        self._frames: deque[CameraFrame | DamagedImage] = deque()
        self._failure: DriverError | None = None
        options = options or DeviceOptions()
        fps = max(parse_mode(each)[2] for each in (options.depth_mode, options.color_mode))
        self._slots = max(4, round(fps * _DEPTH_S) + _MORE)
        self._process = ChildProcess("nurbseg.drivers.live.isolated.program", slots=self._slots)
        self._channel = self._process.connect(CODEC)
        level = logging.getLogger("nurbseg.drivers").getEffectiveLevel()
        self._ask("open_camera", level, wanted, options, pairing_limit_s, patience_s, driver)
        with closed_on_error(self.close):
            while patience_s is None and not self.is_open(_POLL_S):
                pass

    def is_open(self, timeout_s: float = 0.0) -> bool:
        """Whether the camera is open; raises DriverError as on opening."""
        if not self._is_open:
            self._receive(timeout_s)
            # A process that looks for its camera sends a heartbeat after each attempt.
            if self._channel.silent_s > _OPEN_LIMIT_S:
                self._fail(
                    f"{self._driver_name} did not open a camera within {_OPEN_LIMIT_S:g} s; its driver hangs"
                )
            if self._failure is not None:
                raise self._failure
        return self._is_open and not self._closed

    @property
    def losses(self) -> Mapping[str, int]:
        """Frames that were too late or too many for us, and images whose other half never came."""
        return {"missed": self.missed, "half_pairs": self.half_pairs}

    def _ask(self, function: str, *arguments: Any) -> None:
        # Its earlier messages say why the process ended.
        with contextlib.suppress(ChannelClosedError):
            self._channel.send(Call(function, arguments))

    def _receive(self, timeout_s: float) -> None:
        """Receive a message, if one comes in time: keep a frame, take note of a failure."""
        try:
            message = self._channel.receive(max(0.0, timeout_s))
        except ChannelClosedError:
            if self._failure is None:
                code = self._process.end(_END_LIMIT_S)
                self._fail(f"{self._driver_name}'s driver crashed the camera's process, code {code}")
            return
        if isinstance(message, CameraFrame | DamagedImage):
            if len(self._frames) < self._slots:
                self._frames.append(message)
            else:
                self._refused += 1
        elif isinstance(message, Answer):
            if message.raised is None:
                metadata, self.calibration = message.value
                self.metadata.update(metadata)
                self._is_open = True
            # What ends the delivery later is a lost camera, whatever its kind.
            lost = self._is_open and message.raised is not None
            self._failure = DeviceLostError(message.text) if lost else message.raised

    def _fail(self, reason: str) -> None:
        self._failure = self._failure or DeviceLostError(reason)

    def _read(self, timeout_s: float) -> RGBDFrame:
        if not self._begun:
            self._begun = True
            self._ask("begin")
        deadline = time.monotonic() + timeout_s
        while not self._frames:
            if self._failure is not None:
                raise self._failure
            left_s = deadline - time.monotonic()
            self._receive(left_s)
            if self._channel.silent_s > _HANG_LIMIT_S:
                self._fail(f"{self.metadata['device']}: its driver hangs")
            elif left_s <= 0 and not self._frames and self._failure is None:
                raise FrameTimeoutError(
                    f"{self.metadata['device']}: no depth and color within {timeout_s:g} s"
                )
        taken = self._frames.popleft()
        if isinstance(taken, DamagedImage):
            raise FrameFormatError(taken.text)
        self.missed, self.half_pairs = taken.missed + self._refused, taken.half_pairs
        frame = RGBDFrame(
            self._index,
            taken.timestamp_ns,
            taken.depth_mm,
            taken.color,
            self.calibration,
            gravity=taken.gravity,
        )
        self._index += 1
        return frame

    def _close(self) -> None:
        self._channel.finish()
        # Its last messages must be received before it can end.
        deadline = time.monotonic() + (_END_LIMIT_S if self._failure is None else 2.0)
        with contextlib.suppress(ChannelClosedError):
            while (left_s := deadline - time.monotonic()) > 0:
                self._channel.receive(left_s)
        self._process.close(max(0.0, deadline - time.monotonic()))
