"""The state of a run, for whoever shows it: the status line of a terminal, and the page."""

from dataclasses import dataclass, field

from nurbseg.segmentation.config import SegmentationConfig


@dataclass(frozen=True, slots=True)
class RecordingState:
    """A recording: its length, size, lost frames, and the disk space that it may still use, 10^6 bytes."""

    seconds: float
    megabytes: float
    room_mb: float
    lost: int = 0
    ended: bool = False

    @property
    def rate_mb_s(self) -> float | None:
        """Size by length, 10^6 bytes per second; None at the beginning."""
        return self.megabytes / self.seconds if self.seconds > 0 and self.megabytes > 0 else None

    @property
    def brief(self) -> str:
        """Size, and remaining time until the disk is full."""
        left = "" if self.rate_mb_s is None else f", {self.room_mb / self.rate_mb_s / 60:.0f} min left"
        return f"{self.megabytes:.1f} MB{left}"

    def __str__(self) -> str:
        """Return length, size and rate, and the remaining time until the disk is full."""
        if self.ended:
            return "recording stopped"
        size, _, left = self.brief.partition(", ")
        rate = "" if self.rate_mb_s is None else f"{self.rate_mb_s:.1f} MB/s"
        lost = f"{self.lost} lost" if self.lost else ""
        return ", ".join(filter(None, (f"rec {self.seconds:.1f} s", size, rate, left, lost)))


@dataclass(frozen=True, slots=True)
class RunState:
    """What a run does at a moment; `config` holds the settings of the next frame."""

    config: SegmentationConfig = field(default_factory=SegmentationConfig)
    source: str = ""
    #: Why the settings must not change; empty if they may.
    fixed: str = ""
    paused: bool = False
    #: Whether a replay starts again at its end, and its speed; None without a replay, or a paced one.
    loops: bool | None = None
    speed: float | None = None
    #: True if frames can be sought now, otherwise None.
    seekable: bool | None = None
    #: Number of the newest segmented frame; None if nothing is segmented.
    frame: int | None = None
    #: Frames per second and latency from capture to labels, or what is waited for.
    activity: str = "waiting for a frame"
    #: How many objects, or segments, the newest frame has.
    found: str = ""
    #: How many corrections of these a person made, and whether they are saved; empty if there are none.
    corrections: str = ""
    #: Frames that were not segmented, and that were segmented too late to be shown.
    dropped: int = 0
    late: int = 0
    recording: RecordingState | None = None
    #: What the last command has said, and whether it was refused.
    said: str = ""
    refused: bool = False
    #: Whether the run goes on no longer.
    ended: bool = False

    @property
    def is_recording(self) -> bool:
        """Whether frames are being recorded."""
        return self.recording is not None and not self.recording.ended

    @property
    def level(self) -> str | None:
        """What labels stand for; None if the method has surfaces only."""
        return None if self.config.method == "stag15" else self.config.extended.level

    @property
    def piece_pixels(self) -> int:
        """The minimum segment size of the method."""
        config = self.config
        paper = config.method == "stag15"
        return config.stag15.segment_pixels_min if paper else config.extended.piece_pixels_min

    @property
    def status(self) -> tuple[str, ...]:
        """The parts of the status line."""
        config = self.config
        segmented = self.frame is not None
        parts = (
            self.source,
            # Early, to be visible in 80 columns.
            "" if self.recording is None else str(self.recording),
            f"frame {self.frame}" if segmented else "",
            "all frames are shown" if self.ended else self.activity,
            f"{config.method} {config.metric} T {config.ratio_max:g}" if segmented else "",
            self.found,
            self.corrections,
            f"{self.dropped} dropped" + (f", {self.late} late" if self.late else ""),
        )
        return tuple(filter(None, parts))
