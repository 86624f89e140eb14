"""The process that plays an .oni file, and what it sends."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from nurbseg.common.closing import Closing
from nurbseg.common.errors import DriverError, RecordingFormatError
from nurbseg.common.process.channel import ChannelClosedError
from nurbseg.common.process.child import ChildProcess
from nurbseg.drivers.openni2.capi import PixelFormat, Sensor

#: The player must describe what it plays within this time, seconds; starting Python is most of it.
OPEN_LIMIT_S = 30.0
#: And must send an image within this time, seconds, or it hangs.
_HANG_LIMIT_S = 10.0


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
class Played:
    """The end, or why it comes too early."""

    error: DriverError | ValueError | None = None


class PlayerProcess(Closing):
    """Plays a file in a process, which sends a `Description`, each `PlayedImage`, and `Played` at the end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._process = ChildProcess("nurbseg.drivers.openni2.oni.player")
        self._channel = self._process.channel
        self._channel.send(str(path.absolute()))

    def receive(self, timeout_s: float) -> Any:
        """Return what it sends next, or None if it does not come in time.

        Raises RecordingFormatError if the player has died or hangs.
        """
        try:
            answer = self._channel.receive(max(0.0, timeout_s))
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
