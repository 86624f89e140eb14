"""Commands of a terminal and of a pipe, to the installed program."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from nurbseg.app.live.opening import demo_uri

COMMAND = str(Path(sys.executable).parent / "nurbseg-live")
WORDS = ["--replay", demo_uri(), "--loop", "--view", "none"]


class Terminal:
    """A program in a terminal of its own."""

    def __init__(self, words: list[str], folder: Path) -> None:
        self.said = ""
        self.pid, self.master = pty.fork()
        if self.pid == 0:
            os.chdir(folder)
            os.execv(COMMAND, [COMMAND, *words])

    def wait_for(self, text: str, timeout_s: float = 90.0) -> None:
        deadline_s = time.monotonic() + timeout_s
        while text not in self.said:
            assert time.monotonic() < deadline_s, f"never said {text!r}: {self.said}"
            if select.select([self.master], [], [], 0.2)[0]:
                try:
                    self.said += os.read(self.master, 4096).decode()
                except OSError:
                    pytest.fail(f"ended without {text!r}: {self.said}")

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
                    os.read(self.master, 4096)
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


def test_keys_pause_change_settings_write_a_snapshot_and_quit(tmp_path: Path) -> None:
    with terminal(WORDS, tmp_path) as program:
        before = program.modes()
        program.wait_for("h lists the keys, q quits")
        program.wait_for("frame 0")
        assert program.modes() == 0
        program.type(" ")
        program.wait_for("paused")
        program.type("m")
        program.wait_for("metric mae")
        program.type("e")
        program.wait_for("method stag15")
        program.type("s")
        program.wait_for("snapshot: ")
        program.wait_for("\n")
        program.type("q")
        assert program.exit_code() == 0
        assert program.modes() == before
    (folder,) = tmp_path.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    files = {each.name.partition("_")[2] or each.name for each in folder.iterdir()}
    assert {"labels.png", "objects.json", "tree.json", "surfaces.npz", "color.png", "depth.png"} <= files
    assert any(each.endswith(".ply") for each in files)
    # The paper's method merges no surfaces into objects.
    assert "objects.png" not in files
    assert '"metric": "mae"' in (folder / "settings.json").read_text()
    (depth,) = folder.glob("*_depth.png")
    labels = cv2.imread(str(folder / depth.name.replace("depth", "labels")), cv2.IMREAD_UNCHANGED)
    measured = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    assert measured.dtype == np.uint16
    assert ((labels > 0) == (measured > 0)).mean() > 0.99


def test_ctrl_c_gives_the_terminal_back(tmp_path: Path) -> None:
    with terminal(WORDS, tmp_path) as program:
        before = program.modes()
        program.wait_for("frame 0")
        program.type("\x03")
        assert program.exit_code() == 130
        assert program.modes() == before


def run_with_lines(lines: str, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [COMMAND, *WORDS, "--control", "lines", *words],
        input=lines,
        capture_output=True,
        text=True,
        timeout=120,
        cwd=folder,
    )


def test_without_a_display_a_page_is_served_until_somebody_quits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    words = ["--replay", "synthetic:?width=96&height=72&frames=3", "--port", "0", "--web-port", "0"]
    with terminal(words, tmp_path) as program:
        program.wait_for("to look: http://127.0.0.1:")
        assert "from another computer, first: ssh -L " in program.said
        program.wait_for("all frames are shown")
        program.type("q")
        assert program.exit_code() == 0


def piped(lines: str, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [COMMAND, *WORDS, "--control", "lines", *words]
    return subprocess.run(command, input=lines, capture_output=True, text=True, timeout=120, cwd=folder)


def test_lines_of_a_pipe_are_commands_and_its_end_is_none(tmp_path: Path) -> None:
    done = piped("level surfaces\nmetric\n nonsense \n", tmp_path, "--duration", "2")
    assert done.returncode == 0
    for said in ("level surfaces", "metric mae", "'nonsense' is no command"):
        assert said in done.stderr


def test_a_pipe_can_quit_and_the_report_says_so(tmp_path: Path) -> None:
    done = piped("quit\n", tmp_path, "--report", "report.json")
    assert done.returncode == 0
    assert '"ended": "quit"' in (tmp_path / "report.json").read_text()
