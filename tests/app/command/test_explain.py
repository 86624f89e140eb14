"""``nurbseg-live --explain``, as a command and in a run."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from waiting import wait_until

from nurbseg.app.command.live_command import main
from nurbseg.app.live.opening import demo_uri


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
    assert main([*words, "--view", "none", "--explain-out", str(tmp_path / "why.html")]) == 0
    page = (tmp_path / "why.html").read_text(encoding="utf-8")
    assert "frame 12, method stag15, metric MAE, T = 1" in page
    said = capfd.readouterr().err
    steps = page.count("<section hidden")
    assert f"explanation in {steps} steps, for any browser: {tmp_path / 'why.html'}" in said
    assert (tmp_path / "why.html").stat().st_mode & 0o777 == 0o600


def test_the_first_frame_of_a_path_goes_to_a_file_with_its_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["--explain", demo_uri(), "--view", "none"]) == 0
    (file,) = tmp_path.iterdir()
    assert re.fullmatch(r"explanation-\d{8}-\d{6}-frame0\.html", file.name)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--replay", demo_uri(), "--explain", "99"], "has 48 frames"),
        (["--replay", demo_uri(), "--explain", "other.mcap"], "--explain other.mcap: expected the number"),
        (["--explain", "nothing.mcap"], "nothing.mcap: no such file"),
        (["--explain", demo_uri(), "--explain-out", "/proc/none/a.html"], "/proc/none"),
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
        (["--explain-out", "a.html"], "argument --explain-out: expected a frame, too"),
    ],
)
def test_flags_of_a_run_do_not_go_with_it(
    words: list[str], said: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(words)
    assert said in capfd.readouterr().err


@pytest.mark.parametrize("mode", ["spawn", "none"])
def test_the_page_is_opened_where_the_viewer_would_be_a_window(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opener = tmp_path / "xdg-open"
    opener.write_text('#!/bin/sh\necho "$1" > "$1.opened"\n')
    opener.chmod(0o700)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    path = tmp_path / "a.html"
    assert main(["--explain", demo_uri(), "--view", mode, "--explain-out", str(path)]) == 0
    opened = tmp_path / "a.html.opened"
    if mode == "spawn":
        wait_until(lambda: opened.is_file() and opened.read_text() == f"{path}\n", "the page is opened", 30.0)
    assert opened.exists() == (mode == "spawn")
