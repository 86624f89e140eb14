"""Messages between the source process and its client; frames go through the ring."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nurbseg.common.errors import DriverError
from nurbseg.common.frame import Calibration
from nurbseg.drivers.depth_unit import DepthUnit
from nurbseg.drivers.options import ColorFormat, SourceOptions


@dataclass(frozen=True, slots=True)
class Playback:
    """How a source is played, as parameters of `nurbseg.drivers.player.Player`."""

    speed: float | None = None
    loop: bool = False
    start: int = 0
    frames: int | None = None
    duration_s: float | None = None
    delay_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """How frames are recorded: see `nurbseg.drivers.process.recording.Recording`."""

    path: Path
    color: ColorFormat = "jpeg95"
    split_s: float | None = None
    delay_s: float = 0.0
    space_min_mb: int = 200


@dataclass(frozen=True, slots=True)
class Recorded:
    """What a recording holds so far.

    `path` is the first of its `files`, of which a process names the newest, `seconds` its length by the
    frames' stamps, `lost` the frames missing from it, `failure` why it ended before it was to, `room_mb` the
    disk space that it may still use.
    """

    path: Path
    files: tuple[Path, ...]
    frames: int = 0
    lost: int = 0
    seconds: float = 0.0
    written_mb: float = 0.0
    room_mb: float = 0.0
    failure: str = ""
    ended: bool = False


@dataclass(frozen=True, slots=True)
class Status:
    """What was lost, is damaged and recorded; sent when it has changed."""

    losses: Mapping[str, int] = field(default_factory=dict)
    connected: bool = True
    read: int = 0
    damaged: int = 0
    damaged_frames: tuple[str, ...] = ()
    recordings: tuple[Recorded, ...] = ()


@dataclass(frozen=True, slots=True)
class Opened:
    """What was opened, also when a camera is back."""

    calibration: Calibration
    metadata: Mapping[str, str]
    depth_unit: DepthUnit | None
    live: bool
    seekable: bool


@dataclass(frozen=True, slots=True)
class Lost:
    """Where a camera whose process has ended goes on: after the frame taken last, after `fruitless` tries."""

    status: Status
    opened: Opened
    recording: RecordOptions | None = None
    fruitless: int = 0
    index: int = -1
    timestamp_ns: int = 0
    arrived_s: float | None = None


@dataclass(frozen=True, slots=True)
class Begin:
    """Open a source, or look for a lost one; with `every`, the source waits for the reader."""

    uri: str
    options: SourceOptions
    playback: Playback
    every: bool | None
    log_level: int
    lost: Lost | None = None


@dataclass(frozen=True, slots=True)
class Failed:
    """Why no frame comes any more, after so many seeks."""

    error: DriverError | OSError | ValueError
    jumps: int = 0


@dataclass(frozen=True, slots=True)
class Order:
    """Do one of: read_on, step, seek, record, end_recording, finish; or set paused, speed or loop."""

    name: str
    argument: Any = None


@dataclass(frozen=True, slots=True)
class Answer:
    """Whether a recording could be started."""

    error: DriverError | OSError | None
