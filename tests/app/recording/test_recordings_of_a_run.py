"""Recordings that are begun and ended while a run goes on: names, frames, and what is said of them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from scripted_source import write_numbered
from waiting import wait_until

from nurbseg.app.live.controls import Controls
from nurbseg.app.recording.recorder import Recorder, RecordError
from nurbseg.app.settings.output_config import RecordConfig
from nurbseg.drivers.process.client import SourceProcess
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig


class Steps:
    """A run on a recording that gives a frame when it is asked to."""

    def __init__(self, config: RecordConfig, name: str, path: Path) -> None:
        self.source = SourceProcess(str(path))
        self.recorder = Recorder(config, self.source, name=name)
        self.source.play(paused=True)
        self.controls = Controls(SegmentationConfig(), self.source, self.recorder)

    def read(self, frames: int) -> None:
        for _ in range(frames):
            self.source.step()
            self.source.read(30.0)

    def wait_until_logged(self, caplog: pytest.LogCaptureFixture, text: str) -> None:
        def is_logged() -> bool:
            self.source.wait(0.05)
            self.recorder.log_finished()
            return text in caplog.text

        wait_until(is_logged, "the end of the recording is logged")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path / "run")
    return tmp_path / "run"


@contextmanager
def run_with(config: RecordConfig, name: str) -> Iterator[Steps]:
    numbered = Path("..", "numbered.mcap")
    write_numbered(numbered, 100)
    steps = Steps(config, name, numbered)
    with steps.source, steps.recorder:
        yield steps


def indexes(path: Path) -> list[int]:
    """Return which frames a recording holds, by their depth."""
    with open_source(path) as source:
        return [int(frame.depth_mm[0, 0]) - 1000 for frame in source]


def test_each_time_it_is_switched_on_the_frames_until_it_is_off_are_a_new_file(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "nurbseg"), run_with(RecordConfig(), "run.mcap") as run:
        run.read(3)
        run.controls.apply("record")
        run.read(4)
        run.controls.apply("record")
        run.read(2)
        run.controls.apply("record on")
        run.read(5)
        run.controls.apply("record off")
        run.read(1)
        run.controls.apply("record on")
        run.read(6)
    assert sorted(path.name for path in folder.iterdir()) == ["run-2.mcap", "run-3.mcap", "run.mcap"]
    assert indexes(folder / "run.mcap") == [3, 4, 5, 6]
    assert indexes(folder / "run-2.mcap") == [9, 10, 11, 12, 13]
    assert indexes(folder / "run-3.mcap") == [15, 16, 17, 18, 19, 20]
    said = [message for message in caplog.messages if message.startswith("recorded ")]
    assert [each.split(",")[0] for each in said] == [f"recorded {frames} frames" for frames in (4, 5, 6)]
    figures = run.recorder.figures()
    assert [figure["frames"] for figure in figures] == [4, 5, 6]
    assert [figure["file"] for figure in figures] == ["run.mcap", "run-2.mcap", "run-3.mcap"]


def test_a_recording_requested_with_the_run_ends_and_continues_in_another_file(folder: Path) -> None:
    with run_with(RecordConfig(file="a.mcap", delay_s=0.1), "a.mcap") as run:
        run.read(5)
        run.controls.apply("record")
        run.read(1)
        run.controls.apply("record")
        run.read(2)
    # 0.1 s are three frames; they count once.
    assert indexes(folder / "a.mcap") == [3, 4]
    assert indexes(folder / "a-2.mcap") == [6, 7]


def test_the_contents_of_a_recording_are_reported_during_the_run(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "nurbseg"), run_with(RecordConfig(), "run.mcap") as run:
        run.controls.apply("record")
        run.read(2)
        run.recorder.log_finished()
        assert caplog.messages == ["recording to run.mcap"]
        run.controls.apply("record")
        # The page shows where it is.
        assert run.controls.state().said == "recording ends: run.mcap"
        run.read(1)
        run.wait_until_logged(caplog, "recorded 2 frames,")
    assert len(caplog.messages) == 3


@pytest.mark.parametrize(
    ("commands", "said"),
    [
        (["record off"], "record: nothing is being recorded"),
        (["record on", "record on"], "record: run.mcap is already being recorded"),
        (["record loudly"], "record: expected one of on, off, got 'loudly'"),
    ],
)
def test_what_cannot_be_switched_is_said(
    folder: Path, commands: list[str], said: str, caplog: pytest.LogCaptureFixture
) -> None:
    with run_with(RecordConfig(), "run.mcap") as run:
        for command in commands:
            run.controls.apply(command)
        assert said in caplog.messages
        run.read(1)


def test_a_file_that_cannot_be_made_costs_the_recording_and_not_the_run(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (folder / "taken").touch()
    with run_with(RecordConfig(), "taken/run.mcap") as run:
        run.controls.apply("record")
        assert caplog.messages == ["record: taken/run.mcap: cannot be written: File exists"]
        run.read(1)
        assert not run.recorder.is_recording


def test_a_failed_recording_is_reported_and_can_be_started_again(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with run_with(RecordConfig(), "run.mcap") as run:
        run.controls.apply("record")
        run.read(2)
        (folder / "run.mcap").unlink()
        run.read(1)
        run.wait_until_logged(caplog, "run.mcap was deleted or moved; the ")
        assert not run.recorder.is_recording
        run.controls.apply("record")
        run.read(2)
    assert indexes(folder / "run.mcap") == [3, 4]


def test_a_failure_of_the_last_recording_is_one_of_the_run(folder: Path) -> None:
    failed = pytest.raises(RecordError, match="deleted or moved")
    with failed, run_with(RecordConfig(), "run.mcap") as run:
        run.controls.apply("record")
        run.read(2)
        (folder / "run.mcap").unlink()
        run.read(1)


def test_a_recording_is_logged_if_an_error_ends_the_run(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Libraries may turn Ctrl-C into an error of their own."""
    caplog.set_level(logging.INFO, "nurbseg")
    failed = pytest.raises(SystemError, match="in a library")
    with failed, run_with(RecordConfig(file="a.mcap"), "a.mcap") as run:
        run.read(2)
        raise SystemError("in a library")
    assert indexes(folder / "a.mcap") == [0, 1]
    assert "recorded 2 frames" in caplog.text


def test_a_recording_is_one_from_its_beginning_to_its_end(folder: Path) -> None:
    with run_with(RecordConfig(), "camera.mcap") as run:
        assert not run.recorder.is_recording
        run.recorder.begin()
        assert run.recorder.is_recording
        run.recorder.end()
        assert not run.recorder.is_recording


def test_a_recording_that_failed_is_only_logged_where_something_else_ends_the_run(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(ZeroDivisionError), run_with(RecordConfig(file="b.mcap"), "b.mcap") as run:
        run.read(1)
        (folder / "b.mcap").unlink()
        run.read(1)
        raise ZeroDivisionError
    assert "b.mcap was deleted or moved" in caplog.text
