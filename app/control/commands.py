"""The commands of a run: their lines, their keys, and what the page shows of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Literal, get_args

from nurbseg.drivers.process.messages import Recorded
from nurbseg.segmentation.config import Level, Method, Metric, SegmentationConfig


@dataclass(frozen=True, slots=True)
class RunState:
    """What a run does at a moment; `config` holds the settings of the next frame."""

    config: SegmentationConfig = field(default_factory=SegmentationConfig)
    source: str = ""
    #: Why the settings must not change; empty if they may.
    fixed: str = ""
    paused: bool = False
    #: True if frames can be sought now, otherwise None.
    seekable: bool | None = None
    #: Number of the newest segmented frame; None if nothing is segmented.
    frame: int | None = None
    #: Frames per second and latency from capture to labels, or what is waited for.
    activity: str = "waiting for a frame"
    #: How many objects, or segments, the newest frame has.
    found: str = ""
    #: Frames that were not segmented, and that were segmented too late to be shown.
    dropped: int = 0
    late: int = 0
    recording: Recorded | None = None
    #: What the last command has said, and whether it was refused.
    said: str = ""
    refused: bool = False
    #: Number of the newest command of the page that was carried out or refused.
    answered: int = 0
    #: File of the newest explanation, a page; empty before the first.
    explained: str = ""
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
    def status(self) -> tuple[str, ...]:
        """The parts of the status line."""
        config = self.config
        segmented = self.frame is not None
        parts = (
            self.source,
            # Early, to be visible in 80 columns.
            "" if self.recording is None else recording_text(self.recording),
            f"frame {self.frame}" if segmented else "",
            "all frames are shown" if self.ended else self.activity,
            f"{config.method} {config.metric} T {config.ratio_max:g}" if segmented else "",
            self.found,
            f"{self.dropped} dropped" + (f", {self.late} late" if self.late else ""),
        )
        return tuple(filter(None, parts))


@dataclass(frozen=True, slots=True)
class Widget:
    """How the page shows a command: its kind and label.

    `value` is the path of its value in the state of a run; where that is None, it cannot be used. A button
    and a switch send one of `lines`; a choice and a number send the only one, with the value after it.
    """

    kind: Literal["button", "switch", "choice", "number"]
    label: str
    value: str
    lines: tuple[str, ...]
    choices: tuple[str, ...] = ()
    step: float = 1.0


@dataclass(frozen=True, slots=True)
class Command:
    """A command as a line, its keys, its help, and its widget on the page."""

    line: str
    #: The line that each key stands for; a number typed before the key is appended if it ends with a space.
    keys: Mapping[str, str]
    text: str
    widget: Widget | None = None

    @property
    def key_names(self) -> str:
        """Its keys, as they are shown."""
        return " ".join("space" if key == " " else key for key in self.keys)


COMMANDS = (
    Command(
        "pause, resume",
        {" ": "pause"},
        "pause and resume; a camera is still read, for its recording",
        Widget("switch", "Pause", "paused", ("pause", "resume")),
    ),
    Command(
        "seek N|+N|-N",
        {",": "seek -1", "<": "seek -10", ">": "seek +10", "g": "seek "},
        "go to a frame of a recording: 1 or 10 back, 10 forward, or the number typed before g",
        Widget("button", "Back", "seekable", ("seek -1",)),
    ),
    Command("step", {".": "step"}, "advance by one frame", Widget("button", "Step", "", ("step",))),
    Command(
        "record on|off",
        {"r": "record"},
        "start or stop recording to a new file; without an argument, toggle",
        Widget("switch", "Record", "is_recording", ("record on", "record off")),
    ),
    Command(
        "snapshot",
        {"s": "snapshot"},
        "write all of this frame into a new folder",
        Widget("button", "Snapshot", "", ("snapshot",)),
    ),
    Command(
        "explain",
        {"x": "explain"},
        "show why this frame was segmented so, split by split",
        Widget("button", "Explain", "", ("explain",)),
    ),
    Command(
        "method NAME",
        {"e": "method"},
        "change the segmentation method; without a name, to the other",
        Widget("choice", "Method", "config.method", ("method ",), get_args(Method)),
    ),
    Command(
        "metric NAME",
        {"m": "metric"},
        "change the deciding metric; without a name, to the next one",
        Widget("choice", "Metric", "config.metric", ("metric ",), get_args(Metric)),
    ),
    Command(
        "ratio X, T X",
        {"t": "ratio "},
        "change the ratio below which a split is kept; without a number, add 0.05, from 0.7 to 1.3",
        Widget("number", "T", "config.ratio_max", ("ratio ",), step=0.05),
    ),
    Command(
        "lambda X",
        {"w": "lambda "},
        "change the weight of positions beside colors",
        Widget("number", "λ", "config.geometry_weight", ("lambda ",), step=0.1),
    ),
    Command(
        "depth-max N",
        {"d": "depth-max "},
        "change the maximum depth of the tree",
    ),
    Command(
        "piece-pixels N",
        {"p": "piece-pixels "},
        "change the minimum segment size, in pixels of a 640x480 image",
    ),
    Command(
        "level NAME",
        {"l": "level"},
        "label surfaces or objects; without a name, the other",
        Widget("choice", "Level", "level", ("level ",), get_args(Level)),
    ),
    Command(
        "speed X",
        {"+": "faster", "-": "slower"},
        "replay at X times the recorded rate",
    ),
    Command(
        "loop on|off",
        {"o": "loop"},
        "restart a replay at its end; without an argument, toggle",
    ),
    Command("help", {"h": "help"}, ""),
    Command("quit", {"q": "quit"}, ""),
)

KEYS = {key: line for command in COMMANDS for key, line in command.keys.items()}


def help_text() -> str:
    """Return a list of the commands."""
    rows = (f"  {command.key_names:<9}{command.line:<17}{command.text}".rstrip() for command in COMMANDS)
    title = "commands: keys in a terminal, lines with --control lines, or the page of --view serve"
    return "\n".join((title, *rows))


def recording_text(recording: Recorded, *, brief: bool = False) -> str:
    """Return length, size and rate of a recording, and the time until the disk is full; or only the size."""
    if recording.ended and not brief:
        return "recording stopped"
    seconds, megabytes = recording.seconds, recording.written_mb
    rate = megabytes / seconds if seconds > 0 else 0.0
    parts = (
        "" if brief else f"rec {seconds:.1f} s",
        f"{megabytes:.1f} MB",
        f"{rate:.1f} MB/s" if rate and not brief else "",
        f"{recording.room_mb / rate / 60:.0f} min left" if rate else "",
        f"{recording.lost} lost" if recording.lost and not brief else "",
    )
    return ", ".join(filter(None, parts))


def widget_values(state: RunState) -> dict[str, Any]:
    """Return the value of each widget by its label; None if it cannot be used now."""
    widgets = [command.widget for command in COMMANDS if command.widget is not None]

    def value(path: str) -> Any:
        is_fixed = state.fixed and (path.startswith("config.") or path == "level")
        return True if not path else None if is_fixed else attrgetter(path)(state)

    return {widget.label: value(widget.value) for widget in widgets}
