"""Plays an .oni file with OpenNI2's file driver and sends each image to another process.

This runs as a program of its own, because a damaged file may crash the driver or make it hang;
`PlayerProcess` starts it, and bounds every wait for it.
"""

import contextlib
import ctypes
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from nurbseg.drivers.errors import DriverError, RecordingFormatError
from nurbseg.drivers.openni2.capi import DeviceProperty, DeviceState, PixelFormat, Sensor, StreamProperty
from nurbseg.drivers.openni2.isolated.messages import Failure
from nurbseg.drivers.openni2.opened import OpenedDevice
from nurbseg.drivers.openni2.stream import Stream, wait_for_any
from nurbseg.drivers.process.channel import Channel, ChannelClosedError, connect_to_parent
from nurbseg.drivers.process.child import ChildProcess
from nurbseg.drivers.process.messages import Codec

#: Step by step: the driver advances to the next image only when one is waited for, so none is lost.
_STEPWISE = -1.0
#: Must be longer than any image takes: a second trigger on its way would overwrite an image.
_WAIT_S = 5.0
#: Longest wait for the file's name, and for this process to end; seconds.
_BEGIN_S, _END_S = 30.0, 2.0
#: The player must describe what it plays within this time, seconds; starting Python is most of it.
OPEN_LIMIT_S = 30.0
#: And must send an image within this time, seconds, or it hangs.
_HANG_LIMIT_S = 10.0
#: Images that may wait.
_SLOTS = 4


@dataclass(frozen=True, slots=True)
class Play:
    """Play a file."""

    path: str


@dataclass(frozen=True, slots=True)
class StreamDescription:
    """Size in pixels, OpenNI2's pixel format, field of view in radians, and mirroring."""

    size: tuple[int, int]
    format: PixelFormat
    fov: float | None
    mirrored: bool


@dataclass(frozen=True, slots=True)
class Description:
    """What is played."""

    openni2_version: str
    depth: StreamDescription
    color: StreamDescription


@dataclass(frozen=True, slots=True, eq=False)
class PlayedImage:
    """An image: its sensor and number.

    The pixels are depth (H, W) uint16 in the recording's unit, or color (H, W, 3) uint8 RGB.
    """

    sensor: Sensor
    number: int
    pixels: NDArray[Any]


@dataclass(frozen=True, slots=True)
class End:
    """No image follows."""


CODEC = Codec(Play, Description, PlayedImage, End, Failure)
Message = Description | PlayedImage | End | Failure


class PlayerProcess:
    """The process that plays a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._process = ChildProcess("nurbseg.drivers.openni2.oni.player", slots=_SLOTS)
        self._channel = self._process.connect(CODEC)
        self._channel.send(Play(str(path.absolute())))

    def receive(self, timeout_s: float, limit_s: float | None = None) -> Message | None:
        """Return the next message, or None if it does not come in time.

        Raises RecordingFormatError if the player has died, or has sent nothing for `limit_s`.
        """
        deadline = time.monotonic() + timeout_s
        try:
            while True:
                left_s = deadline - time.monotonic()
                message: Message | None = self._channel.receive(max(0.0, left_s))
                if message is not None:
                    return message
                if self._channel.silent_s >= (_HANG_LIMIT_S if limit_s is None else limit_s):
                    raise RecordingFormatError(
                        f"{self._path}: OpenNI2's file driver hangs on it; the file is damaged"
                    )
                if left_s <= 0:
                    return None
        except ChannelClosedError:
            code = self._process.end(OPEN_LIMIT_S)
            raise RecordingFormatError(
                f"{self._path}: OpenNI2's file driver stopped with code {code}; the file is damaged"
            ) from None

    def close(self) -> None:
        """End the process."""
        self._process.close()


def _description(stream: Stream) -> StreamDescription:
    mode = stream.mode
    return StreamDescription(
        (mode.width, mode.height),
        mode.pixel_format,
        stream.find(StreamProperty.HORIZONTAL_FOV, ctypes.c_float),
        bool(stream.find(StreamProperty.MIRRORING, ctypes.c_int)),
    )


def _send(channel: Channel, message: Any) -> None:
    while not channel.send(message, 0.0):
        # Until the other process has taken an image before.
        channel.receive(_WAIT_S)


def play(path: str, channel: Channel) -> None:
    """Send a description, every image in the order of the file, and the end.

    Raises DriverError if OpenNI2 cannot play it.
    """
    ended: list[bool] = []

    def on_event(event: str) -> None:
        if event == f"state {DeviceState.EOF.value}":
            ended.append(True)

    with OpenedDevice(path, on_event) as device:
        device.set(DeviceProperty.PLAYBACK_REPEAT_ENABLED, ctypes.c_int(0))
        device.set(DeviceProperty.PLAYBACK_SPEED, ctypes.c_float(_STEPWISE))
        streams: tuple[Stream, ...] = (
            device.add_stream(Sensor.DEPTH),
            device.add_stream(Sensor.COLOR),
        )
        depth, color = map(_description, streams)
        _send(channel, Description(device.library.version(), depth, color))
        for stream in streams:
            stream.start()
        while True:
            ready = wait_for_any(device.library, streams, 0.2 if ended else _WAIT_S)
            if ready is None:
                break
            image = ready.take()
            if image is not None:
                _send(channel, PlayedImage(ready.sensor, image.number, image.pixels))
        _send(channel, End())


def main() -> int:
    """Play the file that the first message names."""
    channel = connect_to_parent(CODEC, limit_s=_END_S)
    with contextlib.suppress(ChannelClosedError):
        request = channel.receive(_BEGIN_S)
        if not isinstance(request, Play):
            return 1
        try:
            play(request.path, channel)
        except DriverError as err:
            _send(channel, Failure.of(err))
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
