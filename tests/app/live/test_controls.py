"""Commands: what each changes, and what is said of it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from scripted_source import write_numbered

from nurbseg.app.control.commands import COMMANDS, KEYS, widget_values
from nurbseg.app.live.controls import Controls
from nurbseg.app.recording.recorder import Recorder
from nurbseg.app.settings.output_config import RecordConfig
from nurbseg.common.errors import FrameTimeoutError
from nurbseg.drivers.process.client import SourceProcess
from nurbseg.drivers.process.messages import Playback
from nurbseg.segmentation.config import SegmentationConfig


@pytest.fixture(scope="module")
def numbered(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_numbered(tmp_path_factory.mktemp("controls") / "numbered.mcap", 200))


@pytest.fixture
def replay(numbered: str) -> Iterator[SourceProcess]:
    with SourceProcess(numbered, playback=Playback(speed=4.0)) as source:
        yield source


@pytest.fixture
def camera() -> Any:
    """What a source says that is a camera."""
    return SimpleNamespace(seekable=False, speed=None, loop=None, paused=False, recordings=())


def controls_of(source: SourceProcess, *, fixed: str = "") -> Controls:
    return Controls(SegmentationConfig(), source, Recorder(RecordConfig(), source), fixed=fixed)


@pytest.fixture
def controls(replay: SourceProcess) -> Controls:
    return controls_of(replay)


@pytest.mark.parametrize(
    ("command", "name", "expected"),
    [
        ("metric vgc", "metric", "vgc"),
        ("metric VGC", "metric", "vgc"),
        ("metric", "metric", "mae"),
        ("level surfaces", "level", "surfaces"),
        ("level", "level", "surfaces"),
        ("method", "method", "stag15"),
        ("ratio 0.9", "ratio_max", 0.9),
        ("ratio", "ratio_max", 1.05),
        ("T 0.9", "ratio_max", 0.9),
        ("lambda 2.5", "geometry_weight", 2.5),
        ("depth-max 3", "depth_max", 3),
    ],
)
def test_a_setting_is_that_of_the_next_frame(
    controls: Controls, command: str, name: str, expected: object, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "nurbseg"):
        controls.apply(command)
    section = controls.config.extended if name == "level" else controls.config
    assert getattr(section, name) == expected
    said = {"ratio_max": "ratio", "geometry_weight": "lambda", "depth_max": "depth-max"}.get(name, name)
    assert caplog.messages == [f"{said} {expected}"]
    assert (controls.state().said, controls.state().refused) == (f"{said} {expected}", False)


def test_the_minimum_segment_size_is_that_of_the_method(controls: Controls) -> None:
    controls.apply("piece-pixels 80")
    assert controls.config.extended.piece_pixels_min == 80
    controls.apply("method stag15")
    controls.apply("piece-pixels 2000")
    assert controls.config.stag15.segment_pixels_min == 2000
    assert controls.config.extended.piece_pixels_min == 80


def test_the_paper_s_method_has_no_levels(controls: Controls, caplog: pytest.LogCaptureFixture) -> None:
    controls.apply("method stag15")
    controls.apply("level surfaces")
    assert controls.config.extended.level == "objects"
    assert "level: the method stag15 has surfaces only" in caplog.text


def test_the_key_for_the_ratio_comes_round(controls: Controls) -> None:
    ratios = []
    for _ in range(14):
        controls.apply("ratio")
        ratios.append(controls.config.ratio_max)
    assert min(ratios) == 0.7
    assert max(ratios) == 1.3
    assert len(set(ratios)) == 13


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("metric rmse", "metric: expected one of mse, mae, "),
        ("method nurbs", "method: expected one of stag15, nurbseg, got 'nurbs' (did you mean nurbseg?)"),
        ("ratio -1", "ratio: expected a finite number, more than 0, got -1"),
        ("lambda -1", "lambda: expected a finite number, at least 0, got -1"),
        ("depth-max 2.5", "depth-max: expected a whole number, at least 0, at most 64, got 2.5"),
        ("piece-pixels 0", "piece-pixels: expected a whole number, at least 1, got 0"),
        ("ratio much", "ratio: expected a finite number, more than 0, got 'much'"),
        ("speed", "speed: expected a number, got ''"),
        ("speed 0", "speed: expected more than 0, got 0"),
        ("dance", "'dance' is not a command; help lists them"),
    ],
)
def test_what_cannot_be_done_is_said_and_changes_nothing(
    controls: Controls, command: str, said: str, caplog: pytest.LogCaptureFixture
) -> None:
    controls.apply(command)
    assert controls.config == SegmentationConfig()
    (message,) = caplog.messages
    assert message.startswith(said)
    assert (controls.state().said, controls.state().refused) == (message, True)


def test_settings_of_an_export_stay(replay: SourceProcess, caplog: pytest.LogCaptureFixture) -> None:
    controls = controls_of(replay, fixed="an export holds one run's settings")
    controls.apply("metric")
    assert controls.config == SegmentationConfig()
    assert caplog.messages == ["metric: an export holds one run's settings"]


def test_speed_is_that_of_a_replay_only(
    controls: Controls, replay: SourceProcess, camera: Any, caplog: pytest.LogCaptureFixture
) -> None:
    controls.apply("slower")
    assert replay.speed == pytest.approx(4.0 / 1.5)
    controls_of(camera).apply("faster")
    assert camera.speed is None
    assert caplog.messages[-1].startswith("faster: speed applies only to replays")


def test_a_replay_is_looped_or_not(
    controls: Controls, replay: SourceProcess, camera: Any, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "nurbseg"):
        states = []
        for command in ("loop", "loop", "loop on", "loop on", "loop off"):
            controls.apply(command)
            states.append(replay.loop)
        assert states == [True, False, True, True, False]
        controls.apply("loop twice")
        controls_of(camera).apply("loop")
    assert caplog.messages[:2] == ["loop on", "loop off"]
    assert caplog.messages[-2:] == [
        "loop: expected one of on, off, got 'twice'",
        "loop: only a replay can loop",
    ]


def test_frames_are_counted_from_the_one_that_is_shown_or_sought(numbered: str) -> None:
    with SourceProcess(numbered) as source:
        controls = controls_of(source)
        source.seek(50)
        assert source.read(30.0).index == 50
        sought = []
        for command in ("seek +10", "seek 100", "seek +10", "seek -1", "seek -1", "seek -500", "seek +3"):
            controls.apply(command)
            sought.append(source.read(30.0).index)
        assert sought == [60, 100, 110, 109, 108, 0, 3]
        controls.apply("pause")
        for _ in range(2):
            controls.apply("seek 7")
        assert not source.waits
        assert source.read(30.0).index == 7
        assert source.waits
        with pytest.raises(FrameTimeoutError, match="paused"):
            source.read(0.3)


@pytest.mark.parametrize("word", ["", "x", "1.5", "+", "--1"])
def test_what_is_no_frame_number_is_said(
    controls: Controls, word: str, caplog: pytest.LogCaptureFixture
) -> None:
    controls.apply(f"seek {word}")
    assert caplog.messages == [f"seek: expected a frame's number, +N or -N, got {word!r}"]


def test_seeking_is_refused_where_frames_must_come_in_order(
    replay: SourceProcess, camera: Any, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    controls_of(camera).apply("seek 3")
    controls_of(replay, fixed="an export").apply("seek 3")
    recorder = Recorder(RecordConfig(file=str(tmp_path / "a.mcap")), replay)
    with recorder:
        Controls(SegmentationConfig(), replay, recorder).apply("seek 3")
        said = [message.split(";")[0] for message in caplog.messages]
    assert said == [
        "seek: a camera cannot seek",
        "seek: exporting needs the frames in order",
        "seek: recording needs the frames in order",
    ]


def test_after_a_pause_frames_are_stepped_through_one_by_one(numbered: str) -> None:
    with SourceProcess(numbered) as source:
        controls = controls_of(source)
        assert [source.read(30.0).index for _ in range(4)] == [0, 1, 2, 3]
        controls.apply("pause")
        with pytest.raises(FrameTimeoutError, match="paused"):
            source.read(0.3)
        for number in (4, 5, 6):
            controls.apply("step")
            assert source.read(30.0).index == number
        assert source.paused
        controls.apply("pause")
        assert not source.paused
        assert [source.read(30.0).index for _ in range(20)] == list(range(7, 27))


def test_every_key_is_a_command_and_in_the_help(
    controls: Controls, caplog: pytest.LogCaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with caplog.at_level(logging.INFO, "nurbseg"), controls.recorder:
        controls.apply("help")
        (text,) = caplog.messages
        for key, command in KEYS.items():
            assert f"\n  {'space' if key == ' ' else key} " in text or f" {key} " in text
            controls.apply(command)
    assert not any("not a command" in message for message in caplog.messages)
    assert controls.ended


def test_the_documentation_lists_every_command_and_key() -> None:
    page = (Path(__file__).parents[3] / "docs" / "viewer.md").read_text()
    table = page.partition("| key | line |")[2].partition("\n\n")[0].replace("\\|", "|")
    for command in COMMANDS:
        for line in command.line.split(", "):
            assert f"`{line}`" in table
        for key in command.keys:
            assert (f"`{key}`" if key != " " else "| space |") in table


def test_the_state_says_what_cannot_be_used(replay: SourceProcess, camera: Any) -> None:
    def unused(controls: Controls) -> set[str]:
        return {label for label, value in widget_values(controls.state()).items() if value is None}

    assert unused(controls_of(replay)) == set()
    fixed = controls_of(replay, fixed="an export")
    settings = {"Method", "Metric", "T", "λ", "Level"}
    assert unused(fixed) == {*settings, "Back"}
    controls = controls_of(camera)
    assert unused(controls) == {"Back"}
    controls.apply("method stag15")
    assert unused(controls) == {"Back", "Level"}


def test_every_widget_gives_commands_that_a_run_executes(
    controls: Controls, caplog: pytest.LogCaptureFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with controls.recorder:
        values = widget_values(controls.state())
        for command in COMMANDS:
            for line in () if command.widget is None else command.widget.lines:
                controls.apply(f"{line}{values[command.widget.label]}" if line.endswith(" ") else line)
    assert [message for message in caplog.messages if "no frames were recorded" not in message] == []


def test_commands_of_other_threads_take_effect_at_once_until_the_run_has_ended(controls: Controls) -> None:
    states = []
    controls.changed = lambda: states.append(controls.state())
    for number, command in enumerate(("pause", "ratio 0.9"), start=1):
        controls.ask(command, number)
    assert [(state.paused, state.config.ratio_max, state.answered) for state in states] == [
        (True, 1.0, 1),
        (True, 0.9, 2),
    ]
    controls.changed = lambda: 1 // 0  # type: ignore[assignment, return-value]
    controls.ask("ratio 0.8")
    assert isinstance(controls.error, ZeroDivisionError)
    controls.close()
    controls.ask("ratio 0.7")
    assert controls.config.ratio_max == 0.8
