"""The installed nurbseg-live in a terminal of its own; every wait for it has a limit."""

from __future__ import annotations

import os
import pty
import re
import select
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

COMMAND = str(Path(sys.executable).parent / "nurbseg-live")


class Terminal:
    """A program in a terminal of its own."""

    def __init__(self, words: list[str], folder: Path) -> None:
        self.said = ""  # since something was typed last
        self.all_said = ""
        self.pid, self.master = pty.fork()
        if self.pid == 0:
            os.chdir(folder)
            os.execv(COMMAND, [COMMAND, *words])

    def wait_for(self, text: str) -> None:
        self._read_until(lambda: text in self.said, text)

    def wait_for_line(self, pattern: str) -> None:
        self._read_until(lambda: re.fullmatch(pattern, self.lines()[-1]) is not None, pattern)

    def _read_until(self, condition: Callable[[], bool], what: str) -> None:
        deadline_s = time.monotonic() + 90.0
        while not condition():
            assert time.monotonic() < deadline_s, f"never said {what!r}: {self.said}"
            if select.select([self.master], [], [], 0.2)[0]:
                try:
                    self._read()
                except OSError:
                    pytest.fail(f"ended without {what!r}: {self.said}")

    def _read(self) -> None:
        text = os.read(self.master, 4096).decode()
        self.said += text
        self.all_said += text

    def lines(self) -> list[str]:
        """Return what the terminal shows of all that was said: it knows return, line feed and erase."""
        shown = [""]
        column = 0
        for piece in re.findall(r"\x1b\[K|\x1b.|[\r\n]|[^\x1b\r\n]+", self.all_said):
            if piece == "\n":
                shown.append("")
            elif piece == "\x1b[K":
                shown[-1] = shown[-1][:column]
            elif piece != "\r":
                assert "\x1b" not in piece
                shown[-1] = shown[-1][:column] + piece + shown[-1][column + len(piece) :]
            column = 0 if piece in "\r\n" else column if piece == "\x1b[K" else column + len(piece)
        return shown

    def resize(self, columns: int) -> None:
        termios.tcsetwinsize(self.master, (24, columns))

    def type(self, keys: str) -> None:
        self.said = ""
        os.write(self.master, keys.encode())

    def modes(self) -> int:
        return int(termios.tcgetattr(self.master)[3]) & (termios.ECHO | termios.ICANON)

    def exit_code(self) -> int:
        deadline_s = time.monotonic() + 60.0
        while time.monotonic() < deadline_s:
            # What is still said must be read, or the program waits for room.
            with suppress(OSError):
                if select.select([self.master], [], [], 0.1)[0]:
                    self._read()
            ended, status = os.waitpid(self.pid, os.WNOHANG)
            if ended:
                return os.waitstatus_to_exitcode(status)
        pytest.fail("does not end")


@contextmanager
def terminal(words: list[str], folder: Path) -> Iterator[Terminal]:
    opened = Terminal(words, folder)
    try:
        yield opened
    finally:
        with suppress(ProcessLookupError, ChildProcessError):
            os.kill(opened.pid, 9)
            os.waitpid(opened.pid, 0)
        os.close(opened.master)
