"""How commands are read: keys of a terminal, or lines of standard input."""

import logging
import os
import select
import string
import sys
import termios
import tty
from collections import deque
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Self

from nurbseg.app.control.commands import KEYS
from nurbseg.app.live.progress import StatusLine, in_foreground
from nurbseg.app.settings.app_config import Control

_log = logging.getLogger(__name__)


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
            if key in string.digits or (key == "." and self._unfinished.isdecimal()):
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
