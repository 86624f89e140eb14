import itertools
from dataclasses import replace

import numpy as np
import pytest
from fake_clock import FakeClock
from scripted_source import NumberedSource, ScriptedSource, small_frame

from nurbseg.drivers import (
    DriverError,
    EndOfRecordingError,
    FrameFormatError,
    FrameTimeoutError,
    Player,
)


def recording(frames: int) -> ScriptedSource:
    return ScriptedSource([small_frame(index) for index in range(frames)])


def test_a_looped_recording_continues_with_rising_numbers_and_stamps() -> None:
    with Player(recording(3), reopen=lambda: recording(3), loop=True) as source:
        frames = [source.read() for _ in range(8)]
    assert [frame.index for frame in frames] == list(range(8))
    steps_ns = [b.timestamp_ns - a.timestamp_ns for a, b in itertools.pairwise(frames)]
    assert steps_ns == pytest.approx([33_333_333] * 7, abs=2)
    assert [int(frame.depth_mm[0, 0]) - 1000 for frame in frames] == [0, 1, 2, 0, 1, 2, 0, 1]


@pytest.mark.parametrize("frames", [1, 2])
def test_a_looped_recording_with_one_time_still_has_rising_stamps(frames: int) -> None:
    def recording() -> ScriptedSource:
        return ScriptedSource([replace(small_frame(index), timestamp_ns=7) for index in range(frames)])

    with Player(recording(), reopen=recording, loop=True) as source:
        stamps = [source.read().timestamp_ns for _ in range(3 * frames)][::frames]
    assert stamps[0] < stamps[1] < stamps[2]


def test_a_loop_can_be_begun_and_ended_while_it_is_read() -> None:
    with Player(recording(3), reopen=lambda: recording(3)) as source:
        first = [source.read() for _ in range(3)]
        source.loop = True
        again = [source.read() for _ in range(2)]
        source.loop = False
        again.append(source.read())
        with pytest.raises(EndOfRecordingError, match="the script is over"):
            source.read()
    assert [frame.index for frame in first + again] == [0, 1, 2, 3, 4, 5]


def test_a_loop_of_a_part_of_a_recording_continues_with_rising_numbers() -> None:
    def part() -> ScriptedSource:
        return ScriptedSource([FrameFormatError("bad"), *(small_frame(index) for index in (11, 12))])

    with Player(part(), reopen=part, loop=True) as source:
        indexes = []
        for _ in range(3):
            with pytest.raises(FrameFormatError):
                source.read()
            indexes += [source.read().index for _ in range(2)]
    assert indexes == [11, 12, 13, 14, 15, 16]


def test_in_a_later_pass_numbers_lead_to_the_frames_that_had_them_and_then_go_on_from_the_recording_s() -> (
    None
):
    with Player(NumberedSource(5), reopen=lambda: NumberedSource(5), loop=True) as source:
        for _ in range(13):
            source.read()
        indexes = []
        for index in (11, 8, 9):
            source.seek(index)
            indexes.append([source.read().index for _ in range(3)])
        rest = [source.read() for _ in range(6)]
        source.seek(0)
        source.read()
        source.seek(4)
        seam = [source.read().timestamp_ns for _ in range(2)]
    assert np.diff(seam) == pytest.approx(33_333_333, abs=2)
    # Frame 11 was the recording's frame 1 in the third pass, and frame 8 its frame 3 in the second.
    assert indexes == [[1, 2, 3], [3, 4, 5], [4, 5, 6]]
    assert [frame.index for frame in rest] == [7, 8, 9, 10, 11, 12]
    assert [int(frame.depth_mm[0, 0]) - 1000 for frame in rest] == [2, 3, 4, 0, 1, 2]
    stamps = [frame.timestamp_ns for frame in rest]
    assert np.diff(stamps) == pytest.approx(33_333_333, abs=2)


def test_a_frame_that_somebody_goes_to_is_due_at_once_and_the_next_ones_after_it() -> None:
    clock = FakeClock()
    with Player(NumberedSource(900), speed=1.0, duration_s=1.0, clock=clock, sleep=clock.sleep) as source:
        source.read()
        with pytest.raises(FrameTimeoutError):
            source.read(0.01)
        source.seek(600)
        began_s = clock.now_s
        assert source.read().index == 600
        assert clock.now_s == began_s
        # Of the second, the frame that waited took a thirtieth, and the way to the other nothing.
        assert len(list(source)) == 28
        assert clock.now_s - began_s == pytest.approx(28 / 30, abs=1e-6)


def test_a_recording_without_a_good_frame_is_not_repeated_for_ever() -> None:
    def damaged() -> ScriptedSource:
        return ScriptedSource([FrameFormatError("bad")])

    for frames in (0, 1):
        with Player(recording(frames) if frames else damaged(), reopen=damaged, loop=True) as source:
            for _ in range(frames):
                source.read()
            with pytest.raises(FrameFormatError):
                source.read()
            with pytest.raises(EndOfRecordingError, match="no frame to repeat"):
                source.read()


def test_each_pass_of_a_loop_is_closed() -> None:
    passes = [recording(1), recording(1), recording(1)]
    following = iter(passes[1:])
    with Player(passes[0], reopen=lambda: next(following), loop=True) as source:
        for _ in range(3):
            source.read()
    for pass_ in passes:
        with pytest.raises(DriverError, match="closed"):
            pass_.read()


def test_damaged_frames_do_not_count_for_the_limit() -> None:
    script = [FrameFormatError("bad"), small_frame(1), small_frame(2), small_frame(3)]
    with Player(ScriptedSource(script), frames=2) as source:
        with pytest.raises(FrameFormatError):
            source.read()
        assert [frame.index for frame in source] == [1, 2]


def test_a_limit_of_time_goes_by_the_frames_clock() -> None:
    with Player(recording(90), duration_s=1.0) as source:
        assert len(list(source)) == 30


def test_a_silent_camera_ends_with_the_time_too() -> None:
    clock = FakeClock()
    camera = ScriptedSource([FrameTimeoutError("nothing"), FrameTimeoutError("nothing")], live=True)
    with Player(camera, duration_s=1.0, clock=clock) as source:
        with pytest.raises(FrameTimeoutError):
            source.read()
        clock.now_s += 1.0
        with pytest.raises(EndOfRecordingError, match="requested duration"):
            source.read()


def test_the_time_that_a_camera_takes_to_start_does_not_count() -> None:
    clock = FakeClock()
    late = [FrameTimeoutError("nothing"), *(small_frame(index) for index in range(90))]
    with Player(ScriptedSource(late, live=True), duration_s=1.0, clock=clock) as source:
        with pytest.raises(FrameTimeoutError):
            source.read()
        clock.now_s += 0.9
        source.read()
        clock.now_s += 0.9
        assert len(list(source)) == 29


def test_limits_pass_on_what_a_source_is() -> None:
    camera = ScriptedSource([], live=True)
    with Player(camera, frames=1) as source:
        assert source.live
        assert source.calibration is camera.calibration
        assert source.metadata is camera.metadata


@pytest.mark.parametrize(("speed", "expected_s"), [(1.0, 1.0), (2.0, 0.5), (0.5, 2.0)])
def test_a_loop_keeps_its_pace_over_the_seam(speed: float, expected_s: float) -> None:
    clock = FakeClock()
    source = Player(
        recording(10),
        reopen=lambda: recording(10),
        loop=True,
        speed=speed,
        clock=clock,
        sleep=clock.sleep,
    )
    with source:
        for _ in range(31):
            source.read()
    assert clock.now_s - 100.0 == pytest.approx(expected_s, rel=1e-6)


def test_the_delay_counts_neither_frames_nor_time() -> None:
    source = Player(ScriptedSource([small_frame(index) for index in range(90)]), frames=5, delay_s=1.0)
    assert [frame.index for frame in source] == list(range(35))
    source = Player(ScriptedSource([small_frame(index) for index in range(90)]), duration_s=0.5, delay_s=1.0)
    assert [frame.index for frame in source] == list(range(45))


def test_a_restarted_clock_does_not_restart_the_delay() -> None:
    script = [small_frame(index, timestamp_s=(index % 40) / 30) for index in range(90)]
    source = Player(ScriptedSource(script), frames=20, delay_s=1.0)
    assert [frame.index for frame in source] == list(range(50))


def paced(stamps_s: list[float], clock: FakeClock, speed: float = 1.0) -> Player:
    source = ScriptedSource([small_frame(n, stamp_s) for n, stamp_s in enumerate(stamps_s)])
    return Player(source, speed=speed, clock=clock, sleep=clock.sleep)


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
    source = Player(inside, speed=1.0)
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
        Player(inside, speed=speed)


def test_after_a_pause_or_at_another_speed_frames_count_from_the_next_one() -> None:
    clock = FakeClock()
    with paced([0.0, 0.1, 0.2, 0.3, 0.4, 0.5], clock) as source:
        source.read()
        source.paused = True
        with pytest.raises(FrameTimeoutError, match="paused"):
            source.read()
        clock.now_s = 150.0
        source.paused = False
        source.read()
        assert clock.now_s == pytest.approx(150.0)
        source.read()
        assert clock.now_s == pytest.approx(150.1)
        source.speed = 0.5
        source.read()
        assert clock.now_s == pytest.approx(150.1)
        source.read()
        assert clock.now_s == pytest.approx(150.3)


def test_in_a_pause_only_frames_stepped_to_are_read_each_at_once_and_then_it_goes_on_at_its_pace() -> None:
    clock = FakeClock()
    with Player(recording(9), speed=1e-3, clock=clock, sleep=clock.sleep) as player:
        assert player.read().index == 0
        with pytest.raises(FrameTimeoutError, match="due"):
            player.read(0.01)
        player.step()
        player.step()
        began_s = clock.now_s
        frames = [player.read(), player.read()]
        assert [frame.index for frame in frames] == [1, 2]
        assert clock.now_s == began_s
        with pytest.raises(FrameTimeoutError, match="paused"):
            player.read()
        player.paused = False
        player.speed = 1.0
        began_s = clock.now_s
        assert [player.read().index for _ in range(3)] == [3, 4, 5]
        assert clock.now_s - began_s == pytest.approx(2 / 30)


def test_in_a_pause_only_the_frame_that_was_sought_last_is_read() -> None:
    with Player(NumberedSource(100)) as player:
        player.paused = True
        for number in (10, 50):
            player.seek(number)
        frame = player.read()
        assert (frame.index, frame.jumps) == (50, 2)
        with pytest.raises(FrameTimeoutError, match="paused"):
            player.read()
