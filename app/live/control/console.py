"""Reads commands during a run: keys of a terminal, or lines of standard input."""

import logging
import os
import queue
import select
import string
import sys
import termios
import threading
import tty
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Literal, Self

from nurbseg.app.live.control.commands import KEYS
from nurbseg.app.live.control.terminal import StatusLine, in_foreground

_log = logging.getLogger(__name__)

Control = Literal["auto", "lines", "off"]

#: Time between two checks whether the console is closed, seconds.
_LOOK_S = 0.2


class Console:
    """Reads commands from a file descriptor on its own thread.

    With `keys` it is a terminal in which each key is a command; otherwise each line is one.
    """

    def __init__(self, descriptor: int, *, keys: bool) -> None:
        self._descriptor = descriptor
        self._keys = keys
        self._commands: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="console", daemon=True)

    def __enter__(self) -> Self:
        if self._keys:
            self._before = termios.tcgetattr(self._descriptor)
            # Keeps keys that were pressed before.
            tty.setcbreak(self._descriptor, termios.TCSADRAIN)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5.0 * _LOOK_S)
        if self._keys and in_foreground(self._descriptor):
            termios.tcsetattr(self._descriptor, termios.TCSADRAIN, self._before)

    def take(self) -> str | None:
        """Return the next command, or None; never waits."""
        with suppress(queue.Empty):
            return self._commands.get_nowait()
        return None

    def _run(self) -> None:
        unfinished = ""
        while not self._stop.is_set():
            if self._keys and not in_foreground(self._descriptor):
                self._stop.wait(_LOOK_S)
                continue
            if not select.select([self._descriptor], [], [], _LOOK_S)[0]:
                continue
            try:
                text = os.read(self._descriptor, 1024).decode(errors="replace")
            except OSError:
                return
            if not text:
                return
            if self._keys:
                for key in text:
                    if key in string.digits:
                        unfinished += key
                        continue
                    if command := KEYS.get(key):
                        self._commands.put(command + unfinished if command.endswith(" ") else command)
                    unfinished = ""
            else:
                *lines, unfinished = (unfinished + text).split("\n")
                for line in filter(None, map(str.strip, lines)):
                    self._commands.put(line)


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
