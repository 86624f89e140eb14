"""The commands of a run: lines, keys and help."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Command:
    """A command as a line, its keys, and its help."""

    line: str
    #: The line that each key stands for; digits typed before the key are appended if it ends with a space.
    keys: Mapping[str, str]
    text: str


COMMANDS = (
    Command("pause, resume", {" ": "pause"}, "pause and resume; a camera is still read, for its recording"),
    Command("step", {".": "step"}, "advance by one frame"),
    Command("speed X", {"+": "faster", "-": "slower"}, "replay at X times the recorded rate"),
    Command(
        "seek N|+N|-N",
        {",": "seek -1", "<": "seek -10", ">": "seek +10", "g": "seek "},
        "go to a frame of a recording: 1 or 10 back, 10 forward, or the number typed before g",
    ),
    Command("loop on|off", {"o": "loop"}, "restart a replay at its end; without an argument, toggle"),
    Command(
        "record on|off", {"r": "record"}, "start or stop recording to a new file; without an argument, toggle"
    ),
    Command("metric NAME", {"m": "metric"}, "change the deciding metric; without a name, to the next one"),
    Command(
        "ratio X",
        {"t": "ratio"},
        "change the ratio below which a split is kept; without a number, add 0.05, from 0.7 to 1.3",
    ),
    Command("level NAME", {"l": "level"}, "label surfaces, objects or things; without a name, the next"),
    Command("method NAME", {"e": "method"}, "change the segmentation method; without a name, to the other"),
    Command("snapshot", {"s": "snapshot"}, "write all of this frame into a new folder"),
    Command("help", {"h": "help"}, ""),
    Command("quit", {"q": "quit"}, ""),
)

KEYS = {key: line for command in COMMANDS for key, line in command.keys.items()}


def help_text() -> str:
    """Return a list of the commands."""
    rows = (
        f"  {' '.join(command.keys).strip() or 'space':<9}{command.line:<17}{command.text}".rstrip()
        for command in COMMANDS
    )
    title = "commands: keys in a terminal, or lines with --control lines"
    return "\n".join((title, *rows))
