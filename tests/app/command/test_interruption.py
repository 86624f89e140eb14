"""Real signals to the real command: it ends within 2 s, and its files are whole."""

import json
import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest
from rendered import rendered
from rerun.chunk import RrdReader

from nurbseg.app.live.interruption import Interruption

START = Callable[..., Any]
SCENE = rendered("width=96&height=72&frames=30")
FILES = ("--export", "out", "--report", "report.json")
LIMIT_S = 2.0


def assert_files_are_whole(folder: Path) -> None:
    report = json.loads((folder / "report.json").read_text())
    assert report["ended"] == "interrupted"
    trees = sorted((folder / "out").glob("*_tree.json"))
    for tree in trees:
        labels = cv2.imread(str(tree).replace("_tree.json", "_labels.png"), cv2.IMREAD_UNCHANGED)
        assert json.loads(tree.read_text())["segments"][0]["size"] == (labels > 0).sum()
    assert report["frames"]["segmented"] <= len(trees) <= report["frames"]["read"]
    assert not list((folder / "out").glob(".*"))


@pytest.mark.parametrize(
    "pace", [("--loop", "--speed", "0"), ("--loop",), ("--speed", "0.0001")], ids=["fast", "paced", "waiting"]
)
def test_ctrl_c_between_frames(pace: tuple[str, ...], start_live: START, tmp_path: Path) -> None:
    run = start_live("--replay", SCENE, *pace, "--view", "none", *FILES)
    run.wait_for("frame 0")
    code, took_s = run.end_with(signal.SIGINT)
    assert (code, took_s < LIMIT_S) == (130, True), took_s
    assert_files_are_whole(tmp_path)
    frames = json.loads((tmp_path / "report.json").read_text())["frames"]
    run.wait_for("interrupted: ")
    last = run.said[-1]
    count = frames["segmented"]
    assert f"interrupted: {count} frame{'s' * (count != 1)} segmented" in last
    lost = [int(each) for each in re.findall(r"(\d+) overwritten", last)]
    assert sum(lost) == frames["dropped"]["overwritten_by_a_newer_frame"]


def test_ctrl_c_at_the_start(start_live: START, tmp_path: Path) -> None:
    run = start_live("--replay", SCENE, "--speed", "0", "--view", "none", *FILES)
    run.wait_for("source:")
    code, took_s = run.end_with(signal.SIGINT)
    assert (code, took_s < LIMIT_S) == (130, True), took_s


@pytest.fixture
def mute_port() -> Iterator[int]:
    """A port that takes connections and never answers."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield int(server.getsockname()[1])


@pytest.mark.parametrize("viewer", ["absent", "mute"])
def test_ctrl_c_without_a_viewer_that_answers(
    viewer: str, start_live: START, mute_port: int, tmp_path: Path
) -> None:
    port = 1 if viewer == "absent" else mute_port
    run = start_live(
        "--replay",
        SCENE,
        "--loop",
        "--speed",
        "0",
        "--connect",
        f"127.0.0.1:{port}",
        "--save",
        "run.rrd",
        *FILES,
    )
    run.wait_for("frame 0")
    code, took_s = run.end_with(signal.SIGINT)
    assert (code, took_s < LIMIT_S) == (130, True), took_s
    assert_files_are_whole(tmp_path)
    frames = {
        number
        for chunk in RrdReader(tmp_path / "run.rrd").stream()
        if chunk.entity_path == "/world/camera/image/depth" and not chunk.is_static
        for number in chunk.to_record_batch().column("frame").to_pylist()
    }
    assert 0 in frames


def test_ctrl_c_again_and_again_disturbs_no_file(start_live: START, tmp_path: Path) -> None:
    run = start_live(
        "--replay", SCENE, "--loop", "--speed", "0", "--view", "none", "--save", "run.rrd", *FILES
    )
    run.wait_for("frame 0")
    code, took_s = run.end_with(signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGINT)
    assert took_s < LIMIT_S
    assert code in (130, 143)
    assert_files_are_whole(tmp_path)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP], ids=["killed", "terminal-closed"])
def test_sigterm_ends_cleanly_too(number: signal.Signals, start_live: START, tmp_path: Path) -> None:
    run = start_live("--replay", SCENE, "--loop", "--speed", "0", "--view", "none", *FILES)
    run.wait_for("frame 0")
    code, took_s = run.end_with(number)
    assert (code, took_s < LIMIT_S) == (128 + number, True), took_s
    assert_files_are_whole(tmp_path)


def test_a_signal_raises_once_and_is_remembered() -> None:
    before = signal.getsignal(signal.SIGINT)
    with Interruption() as interruption:
        interruption.check()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGINT)
        assert interruption.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            interruption.check()
    assert signal.getsignal(signal.SIGINT) is before


def test_a_run_that_ignores_its_terminal_continues_without_it() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with Interruption() as interruption:
            signal.raise_signal(signal.SIGHUP)
            interruption.check()
            assert interruption.signal_number is None
    finally:
        signal.signal(signal.SIGHUP, before)


def test_while_held_a_signal_raises_nothing_and_is_found_later() -> None:
    with Interruption() as interruption:
        interruption.hold()
        signal.raise_signal(signal.SIGINT)
        assert interruption.exit_code == 130
        with pytest.raises(KeyboardInterrupt):
            interruption.wait()


def test_a_signal_while_llvm_loads_code_waits_until_it_is_loaded() -> None:
    def _raw_object_cache_getbuffer() -> str:
        os.kill(os.getpid(), signal.SIGINT)
        return "loaded"

    end_s = time.monotonic() + 10.0
    with Interruption() as interruption:
        assert _raw_object_cache_getbuffer() == "loaded"
        with pytest.raises(KeyboardInterrupt):
            interruption.wait(lambda: time.monotonic() > end_s)
    assert interruption.exit_code == 130
