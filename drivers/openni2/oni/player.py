"""Plays an .oni file with OpenNI2's file driver, image by image.

This runs as a program of its own, because a damaged file may crash the driver or make it hang;
`PlayerProcess` starts it, and bounds every wait for it.
"""

import ctypes
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from nurbseg.common.closing import Closing
from nurbseg.common.errors import RecordingFormatError
from nurbseg.common.process.channel import ChannelClosedError, connect_to_parent
from nurbseg.common.process.child import ChildProcess
from nurbseg.common.process.codec import Answer, Call, Codec
from nurbseg.drivers.openni2.capi import DeviceProperty, DeviceState, PixelFormat, Sensor, StreamProperty
from nurbseg.drivers.openni2.opened import OpenedDevice
from nurbseg.drivers.openni2.stream import Stream, wait_for_any

#: Step by step: the driver advances to the next image only when one is waited for, so none is lost.
_STEPWISE = -1.0
#: Must be longer than any image takes: a second trigger on its way would overwrite an image.
_WAIT_S = 5.0
#: Longest wait for this process to end, seconds.
_END_S = 2.0
#: The player must describe what it plays within this time, seconds; starting Python is most of it.
OPEN_LIMIT_S = 30.0
#: And must send an image within this time, seconds, or it hangs.
_HANG_LIMIT_S = 10.0
#: Images that may wait.
_SLOTS = 4


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


CODEC = Codec(Description, PlayedImage)


class PlayerProcess(Closing):
    """The process that plays a file: its answers hold a `Description`, then each `PlayedImage`, then None."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._process = ChildProcess("nurbseg.drivers.openni2.oni.player", slots=_SLOTS)
        self._channel = self._process.connect(CODEC)
        self._channel.send(Call(play.__name__, (str(path.absolute()),)))

    def receive(self, timeout_s: float) -> Answer | None:
        """Return the next answer, or None if it does not come in time.

        Raises RecordingFormatError if the player has died or hangs.
        """
        try:
            answer: Answer | None = self._channel.receive(max(0.0, timeout_s))
        except ChannelClosedError:
            code = self._process.end(OPEN_LIMIT_S)
            raise RecordingFormatError(
                f"{self._path}: OpenNI2's file driver stopped with code {code}; the file is damaged"
            ) from None
        if answer is None and self._channel.silent_s >= _HANG_LIMIT_S:
            raise RecordingFormatError(
                f"{self._path}: OpenNI2's file driver hangs on it; the file is damaged"
            )
        return answer

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


def play(path: str) -> Iterator[Description | PlayedImage | None]:
    """Yield a description, every image in the order of the file, and None.

    Raises DriverError if OpenNI2 cannot play it.
    """
    with OpenedDevice(path) as device:
        device.set(DeviceProperty.PLAYBACK_REPEAT_ENABLED, ctypes.c_int(0))
        device.set(DeviceProperty.PLAYBACK_SPEED, ctypes.c_float(_STEPWISE))
        streams = device.add_stream(Sensor.DEPTH), device.add_stream(Sensor.COLOR)
        depth, color = map(_description, streams)
        yield Description(device.library.version(), depth, color)
        for stream in streams:
            stream.start()
        while ready := wait_for_any(
            device.library, streams, 0.2 if DeviceState.EOF in device.states else _WAIT_S
        ):
            if (image := ready.take()) is not None:
                yield PlayedImage(ready.sensor, image.number, image.pixels)
        # Before the driver is closed, which crashes it now and then.
        yield None


def main() -> int:
    """Play the file that is asked for."""
    connect_to_parent(CODEC, limit_s=_END_S).serve({play.__name__: play})
    return 0


if __name__ == "__main__":
    sys.exit(main())
