"""What a source is by itself, and a replay at the recorded pace."""

import numpy as np
import pytest
from fake_clock import FakeClock
from scripted_source import ScriptedSource, small_frame

from nurbseg.drivers import (
    DeviceLostError,
    DriverError,
    EndOfRecordingError,
    FrameFormatError,
    FrameTimeoutError,
    Paced,
)


def paced(stamps_s: list[float], clock: FakeClock, speed: float = 1.0) -> Paced:
    source = ScriptedSource([small_frame(n, stamp_s) for n, stamp_s in enumerate(stamps_s)])
    return Paced(source, speed, clock=clock, sleep=clock.sleep)


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_frames_come_at_their_recorded_moments(speed: float) -> None:
    clock = FakeClock()
    with paced([5.0, 5.1, 5.4, 5.45], clock, speed) as source:
        moments = []
        for _ in source:
            moments.append(clock.now_s - 100.0)
    assert moments == pytest.approx([0.0, 0.1 / speed, 0.4 / speed, 0.45 / speed])


def test_a_late_reader_gets_what_it_missed_at_once_and_delays_do_not_add_up() -> None:
    clock = FakeClock()
    with paced([0.0, 0.1, 0.2, 0.3, 0.4], clock) as source:
        source.read()
        clock.now_s += 0.25
        source.read()
        source.read()
        assert clock.slept_s == []
        source.read()
        assert clock.now_s == pytest.approx(100.3)
        source.read()
        assert clock.now_s == pytest.approx(100.4)


def test_a_frame_that_is_not_due_in_time_is_kept_for_the_next_read() -> None:
    clock = FakeClock()
    with paced([0.0, 2.5, 3.0, 9.0], clock) as source:
        source.read(timeout_s=1.0)
        for _ in range(2):
            with pytest.raises(FrameTimeoutError, match="due in"):
                source.read(timeout_s=1.0)
        assert source.read(timeout_s=1.0).index == 1
        assert clock.now_s == pytest.approx(102.5)
        source.read(timeout_s=1.0)
        with pytest.raises(FrameTimeoutError):
            source.read(timeout_s=1.0)
        # The frame that waits is one of those to pass.
        assert source.skip(2) == 1
        with pytest.raises(EndOfRecordingError):
            source.read(timeout_s=1.0)


def test_a_replay_is_as_slow_as_it_shall_be(caplog) -> None:
    clock = FakeClock()
    with paced([0.0, 0.1, 0.2, 1.0], clock, 1e-3) as source:
        moments = []
        for _ in range(4):
            source.read(timeout_s=1e4)
            moments.append(clock.now_s - 100.0)
    assert moments == pytest.approx([0.0, 100.0, 200.0, 1000.0])
    assert caplog.messages == []


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_a_gap_of_hours_is_said_and_waited_for_ten_seconds_at_most(speed: float, caplog) -> None:
    clock = FakeClock()
    with paced([0.0, 0.5, 7200.0, 7200.5, 0.25, 0.75], clock, speed) as source:
        moments = []
        while True:
            try:
                source.read(timeout_s=30.0)
            except EndOfRecordingError:
                break
            moments.append(clock.now_s - 100.0)
    half = 0.5 / speed
    # Back in time is the next frame's time; from there on it goes as before.
    expected = [0.0, half, half + 10.0, 2 * half + 10.0, 3 * half + 10.0, 4 * half + 10.0]
    assert moments == pytest.approx(expected)
    forward, back = caplog.messages
    assert forward == "frame 2: the timestamp jumps by 7200 s; the replay continues after 10 s"
    assert back == "frame 4: the timestamp goes back by 7200.250 s; the replay continues at once"


@pytest.mark.parametrize(
    "stamps_s",
    [
        # Set back by less than 10 s, wrong once: 0, a year later, a second before; the first one is 0.
        [50.0, 50.1, 50.2, 45.3, 45.4, 45.5],
        [50.0, 50.1, 50.2, 0.0, 50.4, 50.5],
        [50.0, 50.1, 50.2, 3e7, 50.4, 50.5],
        [50.0, 50.1, 50.2, 49.2, 50.4, 50.5],
        [0.0, 50.1, 50.2, 50.3, 50.4, 50.5],
    ],
)
def test_a_replay_keeps_its_rate_past_stamps_that_are_wrong(stamps_s: list[float], caplog) -> None:
    clock = FakeClock()
    with paced(stamps_s, clock) as source:
        moments = [clock.now_s - 100.0 for _ in source]
    assert moments[:3] == pytest.approx([0.0, 0.1, 0.2] if stamps_s[0] else [0.0, 0.0, 0.1])
    assert np.diff(moments[2:]) == pytest.approx(0.1)
    (said,) = caplog.messages
    assert said.startswith(f"frame {3 if stamps_s[0] else 1}: the timestamp ")


def test_a_loop_over_a_source_passes_over_damaged_frames_and_names_the_first(caplog) -> None:
    bad = [FrameFormatError(f"bad {n}") for n in range(30)]
    with ScriptedSource([small_frame(0), *bad, small_frame(31)]) as source:
        assert [frame.index for frame in source] == [0, 31]
        assert source.metadata["damaged"] == "30"
    assert len(caplog.messages) == 20
    assert caplog.messages[0] == "skipped a damaged frame: bad 0"
    assert caplog.messages[-1].endswith("bad 19; further ones are only counted")
    lost = ScriptedSource([small_frame(0), DeviceLostError("gone")])
    with lost as source, pytest.raises(DeviceLostError, match="gone"):
        list(source)


def test_a_frame_read_ahead_and_what_was_raised_ahead_are_neither_lost_nor_passed_twice() -> None:
    clock = FakeClock()
    script = [small_frame(0, 50.0), small_frame(1, 50.1), small_frame(2, 45.0), FrameFormatError("bad")]
    inside = ScriptedSource([*script, small_frame(4, 45.2), small_frame(5, 45.3)])
    with Paced(inside, clock=clock, sleep=clock.sleep) as source:
        assert [source.read().index for _ in range(3)] == [0, 1, 2]
        with pytest.raises(FrameFormatError, match="bad"):
            source.read()
        assert source.read().index == 4
    inside = ScriptedSource([*script, small_frame(4, 45.2), small_frame(5, 45.3)])
    with Paced(inside, clock=clock, sleep=clock.sleep) as source:
        for _ in range(3):
            source.read()
        assert source.skip(2) == 2
        assert source.read().index == 5


def test_skipped_frames_are_not_waited_for() -> None:
    clock = FakeClock()
    with paced([0.0, 10.0, 20.0, 20.5], clock) as source:
        assert source.skip(2) == 2
        assert source.read().index == 2
        assert clock.slept_s == []
        source.read()
        assert clock.slept_s == pytest.approx([0.5])


def test_the_end_and_errors_come_through_and_closing_closes_the_source_inside() -> None:
    inside = ScriptedSource([FrameFormatError("bad"), small_frame(0), EndOfRecordingError("end")])
    source = Paced(inside)
    with pytest.raises(FrameFormatError, match="bad"):
        source.read()
    assert source.read().index == 0
    with pytest.raises(EndOfRecordingError):
        source.read()
    source.close()
    with pytest.raises(DriverError, match="closed"):
        inside.read()


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan")])
def test_a_speed_that_is_none_is_refused(speed: float) -> None:
    inside = ScriptedSource([])
    with inside, pytest.raises(ValueError, match="speed"):
        Paced(inside, speed)


def test_skipping_by_reading_counts_damaged_frames_and_passes_other_errors_on() -> None:
    script = [small_frame(0), FrameFormatError("bad"), small_frame(2), FrameTimeoutError("late")]
    with ScriptedSource(script) as source:
        assert source.skip(2) == 2
        assert source.read().index == 2
        with pytest.raises(FrameTimeoutError):
            source.skip(1)


def test_after_a_pause_or_at_another_speed_frames_count_from_the_next_one() -> None:
    clock = FakeClock()
    with paced([0.0, 0.1, 0.2, 0.3, 0.4, 0.5], clock) as source:
        source.read()
        clock.now_s += 50.0
        source.restart()
        source.read()
        assert clock.now_s == pytest.approx(150.0)
        source.read()
        assert clock.now_s == pytest.approx(150.1)
        source.speed = 0.5
        source.read()
        assert clock.now_s == pytest.approx(150.1)
        source.read()
        assert clock.now_s == pytest.approx(150.3)
