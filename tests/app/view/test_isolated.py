"""The view's own process: what becomes of each when the other is late, stopped or gone."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import psutil
import pytest
from rendered import rendered

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view import isolated as view_isolated
from nurbseg.app.view.drawing.frame import ViewFrame
from nurbseg.app.view.isolated import IsolatedView
from nurbseg.app.view.opening import begin_view, open_view
from nurbseg.app.view.view import State
from nurbseg.drivers.registry import open_source
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import SegmentationConfig
from tests.fakes.fair_clock import FairClock
from tests.fakes.own_children import own_children
from tests.fakes.saved_view import read_saved_view
from tests.fakes.small_scene import CONFIG, numbered
from tests.fakes.waiting import wait_until


def opened(path: Path) -> tuple[IsolatedView, psutil.Process]:
    view = open_view(ViewConfig(mode="none", save=str(path)), CONFIG)
    assert isinstance(view, IsolatedView)
    (program,) = own_children()
    return view, program


def test_a_killed_process_is_reported_and_nothing_waits_for_it(tmp_path: Path, result: FrameResult) -> None:
    view, program = opened(tmp_path / "a.rrd")
    program.kill()
    began_s = time.monotonic()
    with pytest.raises(ViewError, match="the view process ended by signal 9"):
        while time.monotonic() < began_s + 30.0:
            view.show(result)
    with pytest.raises(ViewError, match="ended by signal 9"):
        view.close()
    view.close()
    assert own_children() == []


@pytest.mark.parametrize("saves", [True, False])
def test_what_else_a_run_does_outlives_a_killed_process(
    tmp_path: Path, result: FrameResult, caplog: pytest.LogCaptureFixture, saves: bool
) -> None:
    shown = ViewConfig(mode="connect", connect="127.0.0.1:9", save=str(tmp_path / "a.rrd") if saves else None)
    view = open_view(shown, CONFIG)
    assert isinstance(view, IsolatedView)
    (program,) = own_children()
    view.is_outlived = lambda: True
    view.show(result)
    program.kill()

    def fails() -> bool:
        view.show(result)
        return bool(view.failure)

    wait_until(fails, "the view is lost")
    for _ in range(3):
        view.show(result)
    said = [record.message for record in caplog.records if record.levelname == "ERROR"]
    assert said == ["the view process ended by signal 9; nothing more is shown or saved, but the run goes on"]
    if saves:
        # What is missing from the file is a loss.
        with pytest.raises(ViewError, match="ended by signal 9"):
            view.close()
    else:
        view.close()
    assert own_children() == []


def test_a_run_ends_when_the_last_thing_that_it_did_besides_showing_ends(result: FrameResult) -> None:
    view = open_view(ViewConfig(mode="connect", connect="127.0.0.1:9"), CONFIG)
    assert isinstance(view, IsolatedView)
    (program,) = own_children()
    recording = True
    view.is_outlived = lambda: recording
    program.kill()

    def fails() -> bool:
        view.show(result)
        return bool(view.failure)

    wait_until(fails, "the view is lost")
    recording = False
    with pytest.raises(ViewError, match="ended by signal 9"):
        view.show(result)
    with pytest.raises(ViewError, match="ended by signal 9"):
        view.close()


@pytest.mark.parametrize("slow", [0, 1])
def test_a_frame_that_is_slow_to_draw_is_saved(
    slow: int, tmp_path: Path, result: FrameResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = view_isolated.drawn

    def compiled_first(result: FrameResult, *arguments: Any, **options: Any) -> ViewFrame:
        if result.frame.index == slow:
            time.sleep(3.0)
            # What comes after the drawing takes as long as a busy computer needs.
            monkeypatch.setattr(view_isolated, "_REST_S", 60.0)
        return draw(result, *arguments, **options)

    monkeypatch.setattr(view_isolated, "FILE_PATIENCE_S", 0.5)
    monkeypatch.setattr(view_isolated, "_REST_S", 0.5)
    monkeypatch.setattr(view_isolated, "_BUSY_S", 0.5)
    monkeypatch.setattr(view_isolated, "drawn", compiled_first)
    path = tmp_path / "a.rrd"
    with opened(path)[0] as view:
        for index in range(slow + 1):
            view.show(numbered(result, index))
        wait_until(lambda: view._drawn.is_set() == bool(slow), "earlier frames are drawn")
    assert read_saved_view(path).frames("tree") == [*range(slow + 1)]


def test_the_program_does_not_hold_up_the_segmentation(tmp_path: Path) -> None:
    view, program = opened(tmp_path / "a.rrd")
    with view:
        assert os.getpriority(os.PRIO_PROCESS, program.pid) > os.getpriority(os.PRIO_PROCESS, 0)


def test_signals_for_the_program_do_not_end_the_process_before_it(
    tmp_path: Path, result: FrameResult
) -> None:
    path = tmp_path / "a.rrd"
    view, program = opened(path)
    assert os.getpgid(program.pid) != os.getpgid(0)
    for number in (signal.SIGINT, signal.SIGTERM):
        program.send_signal(number)
        view.show(result)
    view.close()
    assert read_saved_view(path).frames("tree") == [0]


def test_a_stopped_process_fails_a_run_that_is_saved_and_costs_closing_no_more_than_its_limit(
    tmp_path: Path, result: FrameResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_isolated, "_STUCK_S", 0.5)
    view, program = opened(tmp_path / "a.rrd")
    program.suspend()
    with pytest.raises(ViewError, match=r"a\.rrd: took no frame for 0\.5 s"):
        for _ in range(20):
            view.show(result)
    with (
        FairClock() as clock,
        pytest.raises(ViewError, match=r"a\.rrd: not written in time; its last frames are missing"),
    ):
        view.close()
    assert clock.elapsed_s < 5.0
    assert own_children() == []


def test_a_stopped_process_costs_a_run_that_only_shows_nothing_but_frames(result: FrameResult) -> None:
    view = open_view(ViewConfig(mode="connect", connect="127.0.0.1:9"), CONFIG)
    assert isinstance(view, IsolatedView)
    (program,) = own_children()
    program.suspend()
    for index in range(30):
        view.show(numbered(result, index))
    assert view.dropped > 20
    view.close()
    assert own_children() == []


def stand_in(*messages: State) -> MagicMock:
    """Return a process that sends these messages, and then works on without another word."""
    left = iter(messages)

    def receive(timeout_s: float) -> State | None:
        if (message := next(left, None)) is None:
            time.sleep(timeout_s)
        return message

    channel = MagicMock(silent_s=0.0, is_waiting=lambda: False, receive=receive)
    return MagicMock(channel=channel)


def test_closing_takes_no_longer_than_its_limit_though_the_process_still_works(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(view_isolated, "_BUSY_S", 2.0)
    view = IsolatedView(stand_in(State()), ViewConfig(), CONFIG, {}, "run")
    with FairClock() as clock:
        view.close(file_limit_s=1.2)
    assert clock.elapsed_s < 3.0


def test_frames_of_another_size_get_room_and_none_is_lost(tmp_path: Path, result: FrameResult) -> None:
    path = tmp_path / "a.rrd"
    with open_source(rendered("width=320&height=240&frames=1")) as source:
        large = process_frame(source.read(), SegmentationConfig())
    with open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        for index, each in enumerate([result, result, large, result, large, large]):
            view.show(numbered(each, index))
    saved = read_saved_view(path)
    assert saved.frames("world/surfaces") == list(range(6))
    sizes = [len(saved.by_frame["world/camera/image/depth"]["DepthImage:buffer"][n][0]) for n in range(6)]
    assert sizes == [2 * 160 * 120 if n in (0, 1, 3) else 2 * 320 * 240 for n in range(6)]


def test_frames_are_shown_in_full_again_after_a_while(
    tmp_path: Path, result: FrameResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.rrd"
    with open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        view.every_frame_in_full = False
        monkeypatch.setattr(view_isolated, "_IN_FULL_S", 100.0)
        for index in range(5):
            clock = SimpleNamespace(monotonic=lambda ahead_s=60.0 * index: time.monotonic() + ahead_s)
            monkeypatch.setattr(view_isolated, "time", clock)
            view.show(numbered(result, index))
    saved = read_saved_view(path)
    assert saved.frames("objects") == saved.frames("world/surfaces") == [0, 2, 4]
    rates_hz = saved.by_frame["plots/rate"]["Scalars:scalars"]
    assert [rates_hz[index][0] for index in rates_hz] == pytest.approx([1 / 60] * 4, rel=0.1)


def test_stages_that_a_run_adds_later_are_not_drawn(
    tmp_path: Path, result: FrameResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw, added = view_isolated.drawn, threading.Event()

    def drawn_later(*arguments: Any, **options: Any) -> ViewFrame:
        assert added.wait(30.0)
        return draw(*arguments, **options)

    monkeypatch.setattr(view_isolated, "drawn", drawn_later)
    path, elapsed_ms = tmp_path / "a.rrd", {"segment": 1.0}
    with opened(path)[0] as view:
        view.show(replace(result, elapsed_ms=MappingProxyType(elapsed_ms)))
        elapsed_ms["show"] = 2.0
        added.set()
    stages = [entity for entity in read_saved_view(path).by_frame if entity.startswith("plots/latency/")]
    assert stages == ["plots/latency/segment"]


def test_cameras_are_reported_once_and_again_when_they_change(tmp_path: Path, result: FrameResult) -> None:
    path = tmp_path / "a.rrd"
    other = replace(result.frame.calibration.depth, fx=99.0)
    changed = replace(result.frame.calibration, depth=other, color=other)
    with open_view(ViewConfig(mode="none", save=str(path)), CONFIG) as view:
        view.show(result)
        view.show(numbered(result, 1))
        view.show(replace(result, frame=replace(result.frame, index=2, calibration=changed)))
    pinhole = read_saved_view(path).static["world/camera"]["Pinhole:image_from_camera"]
    assert np.reshape(pinhole, (3, 3)).T[0, 0] == 99.0


def test_a_process_begun_for_nothing_is_ended() -> None:
    process = begin_view(ViewConfig(mode="none", save="never.rrd"))
    assert process is not None
    with process:
        assert len(own_children()) == 1
    process.close()
    assert own_children() == []
    assert begin_view(ViewConfig(mode="none")) is None


def test_a_process_that_cannot_be_started_is_named_and_leaves_nothing_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(ViewError, match=r"cannot be started: .*/nowhere/python"):
        begin_view(ViewConfig(mode="none", save="never.rrd"))
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_an_address_of_another_computer_is_named() -> None:
    with pytest.raises(ViewError, match=r"bind 192\.0\.2\.1.*: cannot listen there"):
        open_view(ViewConfig(mode="serve", bind="192.0.2.1"), CONFIG)
    assert own_children() == []


def test_a_frame_that_cannot_be_shown_is_reported_with_its_cause(
    tmp_path: Path, result: FrameResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = view_isolated.drawn

    def without_a_shape(*arguments: Any, **options: Any) -> ViewFrame:
        return replace(draw(*arguments, **options), depth_mm=np.zeros(3, dtype=np.uint16))

    monkeypatch.setattr(view_isolated, "drawn", without_a_shape)
    view, _ = opened(tmp_path / "a.rrd")
    with (
        pytest.raises(ViewError, match=r"a frame cannot be shown \(ValueError\): DepthImage must be 2D"),
        view,
    ):
        view.show(result)
    assert own_children() == []


def test_closing_does_not_wait_for_a_first_frame_that_cannot_be_drawn(
    tmp_path: Path, result: FrameResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> ViewFrame:
        time.sleep(0.5)
        raise ValueError("no shape")

    monkeypatch.setattr(view_isolated, "drawn", fail)
    view, _ = opened(tmp_path / "a.rrd")
    with (
        FairClock() as clock,
        pytest.raises(ViewError, match=r"a\.rrd: a frame cannot be shown \(ValueError\): no shape"),
        view,
    ):
        view.show(result)
    assert clock.elapsed_s < 10.0


def test_a_file_that_is_deleted_after_the_last_frame_is_reported(tmp_path: Path, result: FrameResult) -> None:
    path = tmp_path / "a.rrd"
    view, _ = opened(path)
    view.show(result)
    wait_until(lambda: path.stat().st_size > result.frame.depth_mm.nbytes, "the frame is in the file")
    path.unlink()
    with pytest.raises(ViewError, match=r"a\.rrd: cannot be written: it was deleted while it was written"):
        view.close()


def test_the_memory_of_the_process_is_known(tmp_path: Path, result: FrameResult) -> None:
    with opened(tmp_path / "a.rrd")[0] as view:
        view.show(result)
        assert view.peak_memory_mb() > 20.0
