"""``nurbseg-live --explain``, as a command and in a run."""

from __future__ import annotations

import logging
import re
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from nurbseg.app.command.live_command import main
from nurbseg.app.live.opening import demo_uri
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view import explaining
from nurbseg.app.view.viewer import viewer_command


@pytest.fixture(autouse=True)
def logs(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Leave the logging of other tests as it was."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    package = logging.getLogger("nurbseg").level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    logging.getLogger("nurbseg").setLevel(package)
    logging.captureWarnings(False)


def test_a_frame_of_a_replay_is_explained_by_the_method_that_is_set(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["--replay", demo_uri(), "--explain", "12", "--method", "stag15", "--metric", "mae"]
    assert main([*words, "--view", "none", "--explain-out", str(tmp_path / "why")]) == 0
    page = (tmp_path / "why" / "index.html").read_text(encoding="utf-8")
    assert "frame 12, method stag15, metric MAE, T = 1" in page
    said = capfd.readouterr().err
    steps = re.findall(r"explanation in (\d+) steps: (\S+)", said)
    assert steps == [(str(len(list((tmp_path / "why").glob("*.svg")))), str(tmp_path / "why" / "index.html"))]
    assert f"to look: {viewer_command(tmp_path / 'why' / 'explanation.rrd')}" in said


def test_the_first_frame_of_a_path_goes_to_a_folder_with_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["--explain", demo_uri(), "--view", "none"]) == 0
    (folder,) = tmp_path.iterdir()
    assert re.fullmatch(r"explanation-\d{8}-\d{6}-frame0", folder.name)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--replay", demo_uri(), "--explain", "99"], "has 48 frames"),
        (["--replay", demo_uri(), "--explain", "other.mcap"], "--explain other.mcap: expected the number"),
        (["--explain", "nothing.mcap"], "nothing.mcap: no such file"),
        (["--explain", demo_uri(), "--explain-out", "/proc/none"], "/proc/none"),
    ],
)
def test_what_cannot_be_explained_is_an_error(
    words: list[str], said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--view", "none"]) == 2
    assert said in capfd.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--explain", "3", "--save", "a.rrd"], "one frame is explained instead of a run"),
        (["--explain", "3", "--record", "a.mcap"], "one frame is explained instead of a run"),
        (["--explain-out", "folder"], "argument --explain-out: expected a frame, too"),
    ],
)
def test_flags_of_a_run_do_not_go_with_it(
    words: list[str], said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words)
    assert said in capfd.readouterr().err


@pytest.mark.parametrize("mode", ["spawn", "serve"])
def test_a_viewer_that_listens_gets_the_recording(
    mode: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    started: list[tuple[int, str]] = []

    def start(config: ViewConfig, port: int, *words: str, detached: bool) -> Any:
        started.append((port, *words))
        return SimpleNamespace(wait=lambda timeout_s: 0)

    monkeypatch.setattr(explaining, "start_viewer", start)
    caplog.set_level(logging.INFO, "nurbseg")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        explaining.show_explanation(tmp_path / "why.rrd", ViewConfig(mode=mode, port=port))
    assert started == [(port, str(tmp_path / "why.rrd"))]
    assert "to look" not in caplog.text
    explaining.show_explanation(tmp_path / "why.rrd", ViewConfig(mode=mode, port=port))
    assert len(started) == 1
    assert f"to look: {viewer_command(tmp_path / 'why.rrd')}" in caplog.text


def test_a_viewer_that_takes_nothing_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def wait(timeout_s: float) -> int:
        raise subprocess.TimeoutExpired("rerun", timeout_s)

    monkeypatch.setattr(explaining, "start_viewer", lambda *_, **__: SimpleNamespace(wait=wait))
    with socket.create_server(("127.0.0.1", 0)) as server:
        view = ViewConfig(mode="spawn", port=server.getsockname()[1])
        explaining.show_explanation(tmp_path / "why.rrd", view)
    assert "the viewer does not take the explanation" in caplog.text
