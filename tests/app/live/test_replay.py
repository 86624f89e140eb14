import itertools
from dataclasses import replace

import numpy as np
import pytest
from fake_clock import FakeClock
from scripted_source import NumberedSource, ScriptedSource, small_frame

from nurbseg.app.live.replay import Limited, Looped
from nurbseg.common.errors import DriverError, EndOfRecordingError, FrameFormatError, FrameTimeoutError
from nurbseg.drivers.live.pacing import Paced


def recording(frames: int) -> ScriptedSource:
    return ScriptedSource([small_frame(index) for index in range(frames)])


def test_a_looped_recording_continues_with_rising_numbers_and_stamps() -> None:
    with Looped(recording(3), lambda: recording(3)) as source:
        frames = [source.read() for _ in range(8)]
    assert [frame.index for frame in frames] == list(range(8))
    steps_ns = [b.timestamp_ns - a.timestamp_ns for a, b in itertools.pairwise(frames)]
    assert steps_ns == pytest.approx([33_333_333] * 7, abs=2)
    assert [int(frame.depth_mm[0, 0]) - 1000 for frame in frames] == [0, 1, 2, 0, 1, 2, 0, 1]


@pytest.mark.parametrize("frames", [1, 2])
def test_a_looped_recording_with_one_time_still_has_rising_stamps(frames: int) -> None:
    def recording() -> ScriptedSource:
        return ScriptedSource([replace(small_frame(index), timestamp_ns=7) for index in range(frames)])

    with Looped(recording(), recording) as source:
        stamps = [source.read().timestamp_ns for _ in range(3 * frames)][::frames]
    assert stamps[0] < stamps[1] < stamps[2]


def test_a_loop_can_be_begun_and_ended_while_it_is_read() -> None:
    with Looped(recording(3), lambda: recording(3), repeats=False) as source:
        first = [source.read() for _ in range(3)]
        source.repeats = True
        again = [source.read() for _ in range(2)]
        source.repeats = False
        again.append(source.read())
        with pytest.raises(EndOfRecordingError, match="the script is over"):
            source.read()
    assert [frame.index for frame in first + again] == [0, 1, 2, 3, 4, 5]


def test_a_loop_of_a_part_of_a_recording_continues_with_rising_numbers() -> None:
    def part() -> ScriptedSource:
        return ScriptedSource([FrameFormatError("bad"), *(small_frame(index) for index in (11, 12))])

    with Looped(part(), part) as source:
        indexes = []
        for _ in range(3):
            with pytest.raises(FrameFormatError):
                source.read()
            indexes += [source.read().index for _ in range(2)]
    assert indexes == [11, 12, 13, 14, 15, 16]


def test_in_a_later_pass_numbers_lead_to_the_frames_that_had_them_and_then_go_on_from_the_recording_s() -> (
    None
):
    with Looped(NumberedSource(5), lambda: NumberedSource(5)) as source:
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
    with Paced(Limited(NumberedSource(900), duration_s=1.0), clock=clock, sleep=clock.sleep) as source:
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
        with Looped(recording(frames) if frames else damaged(), damaged) as source:
            for _ in range(frames):
                source.read()
            with pytest.raises(FrameFormatError):
                source.read()
            with pytest.raises(EndOfRecordingError, match="no frame to repeat"):
                source.read()


def test_each_pass_of_a_loop_is_closed() -> None:
    passes = [recording(1), recording(1), recording(1)]
    following = iter(passes[1:])
    with Looped(passes[0], lambda: next(following)) as source:
        for _ in range(3):
            source.read()
    for each in passes:
        with pytest.raises(DriverError, match="closed"):
            each.read()


def test_a_limit_of_frames_ends_a_source() -> None:
    with Limited(recording(9), frames=4) as source:
        assert len(list(source)) == 4


def test_damaged_frames_do_not_count_for_the_limit() -> None:
    script = [FrameFormatError("bad"), small_frame(1), small_frame(2), small_frame(3)]
    with Limited(ScriptedSource(script), frames=2) as source:
        with pytest.raises(FrameFormatError):
            source.read()
        assert [frame.index for frame in source] == [1, 2]


def test_a_limit_of_time_goes_by_the_frames_clock() -> None:
    with Limited(recording(90), duration_s=1.0) as source:
        assert len(list(source)) == 30


def test_a_silent_camera_ends_with_the_time_too() -> None:
    clock = FakeClock()
    camera = ScriptedSource([FrameTimeoutError("nothing"), FrameTimeoutError("nothing")], live=True)
    with Limited(camera, duration_s=1.0, clock=clock) as source:
        with pytest.raises(FrameTimeoutError):
            source.read()
        clock.now_s += 1.0
        with pytest.raises(EndOfRecordingError, match="requested duration"):
            source.read()


def test_limits_pass_on_what_a_source_is() -> None:
    camera = ScriptedSource([], live=True)
    with Limited(camera, frames=1) as source:
        assert source.live
        assert source.calibration is camera.calibration
        assert source.metadata is camera.metadata


def test_a_paced_replay_waits_no_longer_than_its_reader() -> None:
    clock = FakeClock()
    late = ScriptedSource([small_frame(0, 0.0), small_frame(1, 10.0)])
    with Paced(late, clock=clock, sleep=clock.sleep) as source:
        source.read(0.5)
        for _ in range(19):
            with pytest.raises(FrameTimeoutError, match="due in"):
                source.read(0.5)
        assert source.read(0.5).index == 1
    assert max(clock.slept_s) <= 0.5
    assert clock.now_s == pytest.approx(110.0)


@pytest.mark.parametrize(("speed", "expected_s"), [(1.0, 1.0), (2.0, 0.5), (0.5, 2.0)])
def test_a_loop_keeps_its_pace_over_the_seam(speed: float, expected_s: float) -> None:
    clock = FakeClock()
    looped = Looped(recording(10), lambda: recording(10))
    with Paced(looped, speed, clock=clock, sleep=clock.sleep) as source:
        for _ in range(31):
            source.read()
    assert clock.now_s - 100.0 == pytest.approx(expected_s, rel=1e-6)


def test_the_delay_counts_neither_frames_nor_time() -> None:
    source = Limited(ScriptedSource([small_frame(index) for index in range(90)]), frames=5, delay_s=1.0)
    assert [frame.index for frame in source] == list(range(35))
    source = Limited(ScriptedSource([small_frame(index) for index in range(90)]), duration_s=0.5, delay_s=1.0)
    assert [frame.index for frame in source] == list(range(45))


def test_a_restarted_clock_does_not_restart_the_delay() -> None:
    script = [small_frame(index, timestamp_s=(index % 40) / 30) for index in range(90)]
    source = Limited(ScriptedSource(script), frames=20, delay_s=1.0)
    assert [frame.index for frame in source] == list(range(50))
