"""The commands of a run: their lines, their keys, and what the page shows of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Literal, get_args

from nurbseg.app.control.run_state import RunState
from nurbseg.segmentation.config import Level, Method, Metric


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
    Command("merge N M", {}, "make one object of several in a pause, which need not touch"),
    Command(
        "split N, split N all",
        {},
        "undo the last merge of an object in a pause, or cut its only surface; all: into its surfaces",
    ),
    Command("undo", {}, "take the last correction of the frame back"),
    Command("save", {}, "save the objects of the frame as labels, NAME_label.png, in a new folder"),
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
        Widget("number", "Depth", "config.depth_max", ("depth-max ",)),
    ),
    Command(
        "piece-pixels N",
        {"p": "piece-pixels "},
        "change the minimum segment size, in pixels of a 640x480 image",
        Widget("number", "Pixels", "piece_pixels", ("piece-pixels ",), step=20),
    ),
    Command(
        "level NAME",
        {"l": "level"},
        "label surfaces, objects or things; without a name, the next",
        Widget("choice", "Level", "level", ("level ",), get_args(Level)),
    ),
    Command(
        "speed X",
        {"+": "faster", "-": "slower"},
        "replay at X times the recorded rate",
        Widget("number", "Speed", "speed", ("speed ",), step=0.25),
    ),
    Command(
        "loop on|off",
        {"o": "loop"},
        "restart a replay at its end; without an argument, toggle",
        Widget("switch", "Loop", "loops", ("loop on", "loop off")),
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


def widget_values(state: RunState) -> dict[str, Any]:
    """Return the value of each widget by its label; None if it cannot be used now."""
    widgets = [command.widget for command in COMMANDS if command.widget is not None]

    def value(path: str) -> Any:
        is_fixed = state.fixed and (path.startswith("config.") or path in ("level", "piece_pixels"))
        return True if not path else None if is_fixed else attrgetter(path)(state)

    return {each.label: value(each.value) for each in widgets}
