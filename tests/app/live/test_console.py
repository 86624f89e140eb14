"""Commands of a terminal and of a pipe, to the installed program."""

from __future__ import annotations

import json
import os
import pty
import re
import shlex
import subprocess
import termios
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest
from program_in_terminal import COMMAND, terminal
from rendered import rendered
from saved_view import read_saved_view
from waiting import wait_until

from nurbseg.app.live.opening import demo_uri
from nurbseg.drivers.registry import open_source

WORDS = ["--replay", demo_uri(), "--loop", "--view", "none"]


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
        program.type("0.85t")
        program.wait_for("ratio 0.85")
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
    files = {path.name.partition("_")[2] or path.name for path in folder.iterdir()}
    assert {"labels.png", "objects.json", "tree.json", "surfaces.npz", "color.png", "depth.png"} <= files
    assert any(file.endswith(".ply") for file in files)
    # The paper's method merges no surfaces into objects.
    assert "objects.png" not in files
    settings = (folder / "settings.json").read_text()
    assert '"metric": "mae"' in settings
    assert '"ratio_max": 0.85' in settings
    (depth,) = folder.glob("*_depth.png")
    labels = cv2.imread(str(folder / depth.name.replace("depth", "labels")), cv2.IMREAD_UNCHANGED)
    measured = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED)
    assert measured.dtype == np.uint16
    assert ((labels > 0) == (measured > 0)).mean() > 0.99


def test_a_key_records_and_ends_the_recording(tmp_path: Path) -> None:
    with terminal(WORDS, tmp_path) as program:
        program.wait_for("frame 0")
        program.type("r")
        program.wait_for("nurbseg-live: recording to recording-")
        program.wait_for("min left")
        program.type("r")
        program.wait_for("nurbseg-live: recorded ")
        program.type("q")
        assert program.exit_code() == 0
    (path,) = tmp_path.glob("recording-[0-9]*-[0-9]*.mcap")
    with open_source(path) as source:
        frames = len(list(source))
    assert frames > 0
    assert f"nurbseg-live: recorded {frames} frames" in program.all_said


def test_frames_that_are_only_recorded_are_recorded_and_not_at_a_key(tmp_path: Path) -> None:
    words = ["--replay", demo_uri(), "--loop", "--record", "a.mcap", "--record-only"]
    with terminal(words, tmp_path) as program:
        program.wait_for("h lists the keys, q quits")
        program.wait_for("min left")
        for key in "m s":
            program.type(key)
            program.wait_for("--record-only segments and shows nothing")
        program.type("r")
        program.wait_for("nurbseg-live: recorded ")
        program.type("r")
        program.wait_for("nurbseg-live: recording to a-2.mcap")
        wait_until(lambda: (tmp_path / "a-2.mcap").stat().st_size > 500_000, "frames are in the second file")
        program.type("q")
        assert program.exit_code() == 0
    for name in ("a.mcap", "a-2.mcap"):
        with open_source(tmp_path / name) as source:
            assert len(list(source)) > 0
    assert not list(tmp_path.glob("snapshot-*"))


def test_while_paused_keys_go_to_frames_of_a_recording_which_are_shown_at_once(tmp_path: Path) -> None:
    # Every frame is late, and in ordinary times one a second is shown.
    words = ["--replay", demo_uri(), "--speed", "0.05", "--view", "none", "--verbose"]
    words += ["--save", "a.rrd", "--set", "age_max_ms=0.001", "--report", "a.json"]
    with terminal(words, tmp_path) as program:
        program.wait_for("frame 0")
        program.type(" ")
        program.wait_for("nurbseg-live: paused")
        for keys, index in (("12g", 12), (",", 11), ("<", 1), ("<", 0), (">", 10), ("99g", 47), (",", 46)):
            program.type(keys)
            program.wait_for(f"nurbseg-live: frame {index}:")
        program.type("s")
        program.wait_for("nurbseg-live: snapshot: ")
        program.type("q")
        assert program.exit_code() == 0
    (depth,) = tmp_path.glob("snapshot-*-frame46/000046_depth.png")
    with open_source(demo_uri()) as source:
        source.skip(46)
        expected = source.read().depth_mm
    assert np.array_equal(cv2.imread(str(depth), cv2.IMREAD_UNCHANGED), expected)
    shown = read_saved_view(tmp_path / "a.rrd", indexed=False).frames("tree")
    assert {12, 11, 1, 0, 10, 47, 46} <= set(shown)
    # None of them is taken for the successor of the one before.
    assert json.loads((tmp_path / "a.json").read_text())["segmented_anew"]["a jump to another frame"] == 7


def test_ctrl_c_gives_the_terminal_back(tmp_path: Path) -> None:
    with terminal(WORDS, tmp_path) as program:
        before = program.modes()
        program.wait_for("frame 0")
        program.type("\x03")
        assert program.exit_code() == 130
        assert program.modes() == before


def test_keys_are_commands_again_after_a_shell_has_changed_the_terminal(tmp_path: Path) -> None:
    with terminal(WORDS, tmp_path) as program:
        before = termios.tcgetattr(program.master)
        program.wait_for("frame 0")
        assert program.modes() == 0
        # As it does on Ctrl-Z.
        termios.tcsetattr(program.master, termios.TCSANOW, before)
        wait_until(lambda: program.modes() == 0, "keys are read at once")
        program.type("q")
        assert program.exit_code() == 0


def test_a_run_in_the_background_goes_on_and_leaves_the_terminal_alone(tmp_path: Path) -> None:
    master, slave = pty.openpty()
    modes = termios.tcgetattr(slave)
    # Even what only writes to the terminal is stopped there.
    words = shlex.join([COMMAND, *WORDS, "--speed", "0", "--frames", "3"])
    shell = subprocess.Popen(
        ["setsid", "--ctty", "bash", "-c", f"stty tostop; set -m; {words} & wait $!"],
        cwd=tmp_path,
        stdin=slave,
        stdout=slave,
        stderr=slave,
    )
    try:
        assert shell.wait(90.0) == 0
        said = os.read(master, 65536).decode()
        assert "done: 3 frames segmented" in said
        assert termios.tcgetattr(slave)[3] & ~termios.TOSTOP == modes[3]
    finally:
        shell.kill()
        os.close(master)
        os.close(slave)


def test_a_status_line_stays_below_the_log_and_goes_at_the_end(tmp_path: Path) -> None:
    with terminal([*WORDS, "--record", "a.mcap"], tmp_path) as program:
        program.resize(200)
        program.wait_for_line(
            r"demo\.mcap \| rec [\d.]+ s, [\d.]+ MB, [\d.]+ MB/s, \d+ min left \| frame \d+"
            r" \| [\d.]+ frames/s, \d+ ms \| nurbseg mse T 1 \| \d+ objects \| \d+ dropped(, \d+ late)?"
        )
        for _ in range(5):
            program.type("h")
            program.wait_for("  h        help")
            program.wait_for("min left")
        program.type("q")
        assert program.exit_code() == 0
        *log, rest = program.lines()
    assert len([line for line in log if line.startswith("  h        help")]) == 5
    # Nothing is left of the status where the log is.
    assert all(line.startswith(("nurbseg-live: ", "  ")) and " | " not in line for line in log)
    assert rest == ""


def test_without_a_display_a_page_is_served_until_somebody_quits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    words = ["--replay", rendered("width=96&height=72&frames=3"), "--port", "0", "--web-port", "0"]
    with terminal(words, tmp_path) as program:
        program.wait_for("to look: http://127.0.0.1:")
        assert "from another computer, first: ssh -L " in program.said
        program.wait_for("all frames are shown")
        program.type("q")
        assert program.exit_code() == 0


def test_a_run_is_paused_changed_and_ended_from_its_page(tmp_path: Path) -> None:
    words = ["--replay", demo_uri(), "--loop", "--view", "serve", "--port", "0", "--web-port", "0"]
    with terminal(words, tmp_path) as program:
        program.wait_for("to look: http://127.0.0.1:")
        program.wait_for("frame 0")
        found = re.search(r"to look: (http://[\d.:]+/)#(\S+)", program.all_said)
        assert found is not None
        page, token = found.groups()
        for command, said in (("pause", "paused"), ("T 0.9", "ratio 0.9"), ("quit", "quit")):
            program.said = ""
            request = urllib.request.Request(f"{page}run", command.encode(), {"X-Token": token})
            with urllib.request.urlopen(request, timeout=30.0) as answer:
                assert answer.status == 202
            program.wait_for(said)
        assert program.exit_code() == 0


def piped(lines: str, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [COMMAND, *WORDS, "--control", "lines", *words]
    return subprocess.run(command, input=lines, capture_output=True, text=True, timeout=120, cwd=folder)


def test_lines_of_a_pipe_are_commands_and_its_end_is_none(tmp_path: Path) -> None:
    done = piped("level surfaces\nmetric\n nonsense \n", tmp_path, "--duration", "2")
    assert done.returncode == 0
    for said in ("level surfaces", "metric mae", "'nonsense' is not a command"):
        assert said in done.stderr


def test_a_line_ends_a_loop_at_the_end_of_the_recording(tmp_path: Path) -> None:
    done = piped("loop off\n", tmp_path, "--speed", "0", "--splits-max", "1", "--decimation", "8")
    assert done.returncode == 0
    with open_source(demo_uri()) as source:
        frames = len(list(source))
    assert f"done: {frames} frames segmented" in done.stderr


def test_a_snapshot_is_written_before_the_end_also_by_a_last_line_without_an_end(tmp_path: Path) -> None:
    done = piped("snapshot\nquit", tmp_path)
    assert done.returncode == 0
    (folder,) = tmp_path.glob("snapshot-*")
    assert list(folder.glob("*_tree.json"))


def test_a_key_explains_the_frame_of_a_pause_with_the_settings_of_the_run(tmp_path: Path) -> None:
    with terminal([*WORDS, "--method", "stag15"], tmp_path) as program:
        program.wait_for("frame 0")
        program.type(" ")
        program.wait_for("paused")
        program.type("x")
        program.wait_for("explanation: ")
        program.type("q")
        assert program.exit_code() == 0
    (page,) = tmp_path.iterdir()
    assert page.name.startswith("explanation-")
    assert page.stat().st_mode & 0o777 == 0o600
    assert "method stag15, metric MSE, T = 1" in page.read_text(encoding="utf-8")
    assert f"explanation: {page}" in program.all_said


def test_a_pipe_can_quit_and_the_report_says_so(tmp_path: Path) -> None:
    done = piped("quit\n", tmp_path, "--report", "report.json")
    assert done.returncode == 0
    assert '"ended": "quit"' in (tmp_path / "report.json").read_text()
