import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from types import SimpleNamespace
from typing import Any

import pytest
from scripted_source import NumberedSource, ScriptedSource, small_frame

from nurbseg.app.live.capture import Captured, CaptureThread
from nurbseg.common.errors import DeviceLostError, FrameFormatError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.player import Player


def test_every_frame_comes_through_a_lossless_capture_in_order() -> None:
    frames = [small_frame(index) for index in range(20)]
    with ScriptedSource(frames) as source, CaptureThread(source, lossless=True) as capture:
        taken = [captured.frame for captured in iter(lambda: capture.frames.take(10.0), None)]
    assert taken == frames
    assert capture.read == 20
    assert source.readers == {"capture"}


def test_the_newest_frame_wins_and_the_others_are_counted() -> None:
    frames = [small_frame(index) for index in range(9)]
    with ScriptedSource(frames) as source, CaptureThread(source) as capture:
        capture._thread.join(10.0)
        newest = capture.frames.take(10.0)
        assert newest is not None
        assert newest.frame is frames[-1]
        assert capture.frames.take(10.0) is None
    assert (capture.read, capture.frames.dropped) == (9, 8)


def test_damaged_frames_are_named_counted_and_passed_over(caplog: pytest.LogCaptureFixture) -> None:
    script = [small_frame(0), FrameFormatError("b_depth.png: 8 bits"), small_frame(2)]
    with ScriptedSource(script) as source, CaptureThread(source, lossless=True) as capture:
        taken = [captured.frame.index for captured in iter(lambda: capture.frames.take(10.0), None)]
    assert taken == [0, 2]
    assert capture.damaged == 1
    assert capture.damaged_frames == ["b_depth.png: 8 bits"]
    assert "skipped a damaged frame: b_depth.png: 8 bits" in caplog.text


def test_very_many_damaged_frames_are_named_only_at_first(caplog: pytest.LogCaptureFixture) -> None:
    script = [FrameFormatError(f"frame {index}") for index in range(100)]
    with ScriptedSource(script) as source, CaptureThread(source, lossless=True) as capture:
        assert capture.frames.take(10.0) is None
    assert capture.damaged == 100
    assert len(capture.damaged_frames) == 20
    assert len(caplog.records) == 21


@pytest.mark.parametrize("error", [DeviceLostError("gone"), MemoryError(), ZeroDivisionError()])
def test_an_error_in_the_thread_is_raised_where_frames_are_taken(error: Exception) -> None:
    with ScriptedSource([small_frame(0), error]) as source, CaptureThread(source, lossless=True) as capture:
        assert capture.frames.take(10.0) is not None
        with pytest.raises(type(error)):
            capture.frames.take(10.0)


def test_stopping_does_not_wait_for_a_camera_that_is_silent() -> None:
    never = threading.Event()
    with ScriptedSource([], live=True, released=never) as source:
        with CaptureThread(source) as capture, pytest.raises(TimeoutError):
            capture.frames.take(0.01)
        assert not capture._thread.is_alive()


def test_stopping_twice_is_harmless() -> None:
    with ScriptedSource([]) as source, CaptureThread(source) as capture:
        capture.stop()
        capture.stop()


def test_the_rate_of_the_source_is_that_of_its_frames_whatever_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # 12 frames/s; two of three are lost on the way, and once the camera is silent for three seconds.
    indices = range(0, 90, 3)
    arrivals_s = iter([index / 12 + (3.0 if index > 30 else 0.0) for index in indices])
    monkeypatch.setattr("nurbseg.app.live.capture.time", SimpleNamespace(monotonic=lambda: next(arrivals_s)))
    with (
        ScriptedSource([small_frame(index) for index in indices]) as source,
        CaptureThread(source) as capture,
    ):
        capture._thread.join(10.0)
        assert capture.source_hz == pytest.approx(12.0)


@pytest.mark.parametrize("lossless", [False, True])
def test_while_paused_the_frame_that_somebody_goes_to_is_read_and_no_other(lossless: bool) -> None:
    with Player(NumberedSource(1000)) as player:
        capture = CaptureThread(player, lossless=lossless)
        # Paused before it starts: a source that is not waited for might be at its end already.
        player.step()
        with capture:
            captured = capture.frames.take(10.0)
            assert captured is not None
            assert player.takes(captured.frame)
            player.seek(500)
            player.seek(400)
            while (captured := capture.frames.take(10.0)) is not None and not player.takes(captured.frame):
                pass
            assert captured is not None
            assert (captured.frame.index, captured.frame.jumps) == (400, 2)
            with pytest.raises(TimeoutError):
                capture.frames.take(0.3)
            player.paused = False
            captured = capture.frames.take(10.0)
            assert captured is not None
            assert captured.frame.index == 401 if lossless else captured.frame.index > 400


def test_a_jump_says_nothing_of_the_source_s_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    arrivals_s = iter([index / 10 for index in range(100)])
    monkeypatch.setattr("nurbseg.app.live.capture.time", SimpleNamespace(monotonic=lambda: next(arrivals_s)))
    with Player(NumberedSource(1000)) as player:
        capture = CaptureThread(player, lossless=True)
        player.paused = True
        with capture:
            for index in range(40):
                player.seek(20 * index) if index % 2 else player.step()
                assert capture.frames.take(10.0) is not None
        # The steps are one frame each.
        assert capture.source_hz == pytest.approx(10.0)


@pytest.mark.parametrize("error", [FrameFormatError("bad"), FrameTimeoutError("nothing")])
def test_a_camera_that_fails_at_once_each_time_is_not_asked_again_at_once(error: Exception) -> None:
    source = ScriptedSource([error] * 10_000, live=True)
    begin_s = time.monotonic()
    with source, CaptureThread(source) as capture:
        with pytest.raises(TimeoutError):
            capture.frames.take(0.5)
        reads = source.reads
        elapsed_s = time.monotonic() - begin_s
    assert 1 <= reads <= 1 + 100 * elapsed_s


class KeptFrames:
    """A recording in memory that is behind after some of its frames."""

    def __init__(self, behind_after: int) -> None:
        self.frames: list[int] = []
        self.finished = 0
        self._behind_after = behind_after

    @property
    def behind(self) -> bool:
        return len(self.frames) > self._behind_after

    def put(self, frame: RGBDFrame) -> None:
        self.frames.append(frame.index)

    def finish(self) -> None:
        self.finished += 1


@pytest.mark.parametrize("end", [[], [DeviceLostError("gone")]], ids=["end", "error"])
def test_a_recording_gets_every_frame_and_holds_back_what_comes_while_it_is_behind(end: list) -> None:
    recording: Any = KeptFrames(behind_after=3)
    with ScriptedSource([*(small_frame(index) for index in range(6)), *end]) as source:
        capture = CaptureThread(source, lossless=True)
        capture.record(recording)
        with capture:
            taken = [captured.frame.index for captured in taken_until_the_end(capture)]
    assert recording.frames == [0, 1, 2, 3, 4, 5]
    assert taken == [0, 1, 2]
    assert (capture.read, capture.withheld, recording.finished) == (6, 3, 1)


def test_the_next_recording_begins_where_the_one_before_was_finished() -> None:
    recordings: Any = [KeptFrames(behind_after=9), KeptFrames(behind_after=9)]
    with NumberedSource(100) as source, CaptureThread(source, lossless=True) as capture:
        # Capture is at most two frames ahead: one queued, and one that waits to be.
        for recording in recordings:
            capture.record(recording)
            while len(recording.frames) < 4:
                assert capture.frames.take(10.0) is not None
        assert capture.recording is recordings[1]
        capture.record(None)
        assert capture.recording is None
        while not recordings[1].finished:
            assert capture.frames.take(10.0) is not None
        kept = [list(recording.frames) for recording in recordings]
        for _ in range(3):
            assert capture.frames.take(10.0) is not None
    assert [recording.finished for recording in recordings] == [1, 1]
    assert [recording.frames for recording in recordings] == kept
    assert list(chain(*kept)) == list(range(kept[0][0], kept[1][-1] + 1))


def taken_until_the_end(capture: CaptureThread) -> Iterator[Captured]:
    """Yield frames until the source ends or fails."""
    with suppress(DeviceLostError):
        yield from iter(lambda: capture.frames.take(10.0), None)
