"""The commands of a run: their lines, the keys that stand for them, and what the help says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Command:
    """One row of the help.

    Parameters
    ----------
    line : str
        How the command is written as a line.
    keys : mapping of str to str
        Keys, and the line that each stands for; digits typed before a key end one that ends with a space.
    text : str
        What it does.
    """

    line: str
    keys: Mapping[str, str]
    text: str


COMMANDS = (
    Command("pause, resume", {" ": "pause"}, "stop and go on; a camera is read on, for its recording"),
    Command("step", {".": "step"}, "go on for one frame"),
    Command("speed X", {"+": "faster", "-": "slower"}, "replay at X times the recorded rate"),
    Command(
        "seek N|+N|-N",
        {",": "seek -1", "<": "seek -10", ">": "seek +10", "g": "seek "},
        "go to a frame of a recording: 1 or 10 back, 10 on, or the number typed before g",
    ),
    Command("loop on|off", {"o": "loop"}, "start a replay again at its end; without a word the other"),
    Command("record on|off", {"r": "record"}, "record to a new file, or end that; without a word the other"),
    Command("metric NAME", {"m": "metric"}, "decide by another metric; without a name by the next one"),
    Command(
        "ratio X",
        {"t": "ratio"},
        "keep a split below another ratio; without a number by 0.05 more, from 0.7 to 1.3",
    ),
    Command("level NAME", {"l": "level"}, "label surfaces, objects or things; without a name the next"),
    Command("method NAME", {"e": "method"}, "segment by another method; without a name the other"),
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
    title = "commands while it runs: a key in a terminal, or with --control lines a line"
    return "\n".join((title, *rows))
