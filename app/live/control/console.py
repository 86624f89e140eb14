"""The commands of a run, and how they are read: keys of a terminal, or lines of standard input."""

import logging
import os
import select
import string
import sys
import termios
import tty
from collections import deque
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from typing import Self

from nurbseg.app.live.terminal import StatusLine, in_foreground
from nurbseg.app.settings.live_config import Control

_log = logging.getLogger(__name__)


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
    Command("lambda X", {}, "change the weight of positions beside colors"),
    Command("level NAME", {"l": "level"}, "label surfaces, objects or things; without a name, the next"),
    Command("method NAME", {"e": "method"}, "change the segmentation method; without a name, to the other"),
    Command("snapshot", {"s": "snapshot"}, "write all of this frame into a new folder"),
    Command("explain", {"x": "explain"}, "show why this frame was segmented so, split by split"),
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


class Console:
    """Reads commands from a file descriptor.

    With `keys` it is a terminal in which each key is a command; otherwise each line is one.
    """

    def __init__(self, descriptor: int, *, keys: bool) -> None:
        self._descriptor = descriptor
        self._keys = keys
        self._commands: deque[str] = deque()
        self._unfinished = ""
        self._ended = False

    def __enter__(self) -> Self:
        if self._keys:
            self._before = termios.tcgetattr(self._descriptor)
            # Keeps keys that were pressed before.
            tty.setcbreak(self._descriptor, termios.TCSADRAIN)
        return self

    def __exit__(self, *_: object) -> None:
        if self._keys and in_foreground(self._descriptor):
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def take(self) -> str | None:
        """Return the next command, or None; never waits."""
        if not self._commands and not self._ended:
            self._read()
        return self._commands.popleft() if self._commands else None

    def _read(self) -> None:
        if self._keys and not in_foreground(self._descriptor):
            return
        if not select.select([self._descriptor], [], [], 0.0)[0]:
            return
        text = ""
        with suppress(OSError):
            text = os.read(self._descriptor, 1024).decode(errors="replace")
        self._ended = not text
        if not self._keys:
            # The last line may have no end.
            *lines, self._unfinished = (self._unfinished + (text or "\n")).split("\n")
            self._commands.extend(filter(None, map(str.strip, lines)))
            return
        for key in text:
            if key in string.digits:
                self._unfinished += key
                continue
            if command := KEYS.get(key):
                self._commands.append(command + self._unfinished if command.endswith(" ") else command)
            self._unfinished = ""


def open_console(control: Control) -> Console | None:
    """Return the console that a setting asks for; None if there is none."""
    if control == "lines":
        return Console(sys.stdin.fileno(), keys=False)
    return Console(sys.stdin.fileno(), keys=True) if in_terminal(control) else None


def in_terminal(control: Control) -> bool:
    """Whether a user controls the run from a terminal."""
    return control == "auto" and sys.stdin.isatty() and sys.stderr.isatty()


def open_status_line(control: Control) -> AbstractContextManager[StatusLine | None]:
    """Return the status line; None with --quiet, or without a suitable terminal."""
    wanted = in_terminal(control) and _log.isEnabledFor(logging.INFO) and os.environ.get("TERM") != "dumb"
    return StatusLine(sys.stderr) if wanted else nullcontext()
