"""The messages between a camera's process and the one that reads from it."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers import errors
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.frame import Calibration
from nurbseg.drivers.openni2.options import DeviceOptions
from nurbseg.drivers.process.messages import Codec


@dataclass(frozen=True, slots=True)
class Open:
    """Open a camera; where it is not there, look for it every `patience_s` seconds, if that is given."""

    wanted: str
    options: DeviceOptions
    pairing_limit_s: float
    patience_s: float | None
    log_level: int


@dataclass(frozen=True, slots=True)
class Opened:
    """The camera is open."""

    metadata: dict[str, str]
    calibration: Calibration


@dataclass(frozen=True, slots=True)
class Begin:
    """Frames are read from now on."""


@dataclass(frozen=True, slots=True)
class Record:
    """Record to a file, with OpenNI2's recorder."""

    path: str
    lossy: bool


@dataclass(frozen=True, slots=True)
class StopRecording:
    """Finish the recording."""


@dataclass(frozen=True, slots=True)
class Done:
    """What was asked for is done."""


@dataclass(frozen=True, slots=True)
class Failure:
    """What was asked for failed; where it is fatal, the process ends."""

    kind: str
    text: str
    fatal: bool = False

    @classmethod
    def of(cls, error: DriverError, *, fatal: bool = False) -> Self:
        """Return the message for an error."""
        return cls(type(error).__name__, str(error), fatal)

    def error(self) -> DriverError:
        """Return the error that this message describes."""
        kind: type[DriverError] = getattr(errors, self.kind)
        return kind(self.text)


@dataclass(frozen=True, slots=True, eq=False)
class CameraFrame:
    """A pair of images, and how many were lost until then."""

    timestamp_ns: int
    depth_mm: NDArray[np.uint16]
    color: NDArray[np.uint8]
    missed: int
    half_pairs: int


CODEC = Codec(Open, Opened, Begin, Record, StopRecording, Done, Failure, CameraFrame)
