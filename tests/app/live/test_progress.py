import logging
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from fake_clock import FakeClock

from nurbseg.app.control.commands import RunState
from nurbseg.app.live.progress import Progress, StatusLine
from nurbseg.drivers.process.messages import Recorded, Status
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.config import SegmentationConfig


def source_of(**status: int) -> Any:
    return SimpleNamespace(replaced=0, status=Status(**status))


def recorder_of(recording: Recorded | None = None) -> Any:
    return SimpleNamespace(recording=recording)


def test_the_rate_after_a_silence_is_that_of_the_frames_since(
    caplog: pytest.LogCaptureFixture, small_result: FrameResult
) -> None:
    clock = FakeClock()
    source = source_of()
    progress = Progress(source, recorder_of(), clock=clock)

    def stream(seconds: float) -> None:
        for _ in range(round(30 * seconds)):
            clock.now_s += 1 / 30
            progress.segmented(small_result.frame, 3, small_result.elapsed_ms)

    with caplog.at_level(logging.INFO, "nurbseg"):
        stream(4.0)
        for _ in range(3):
            clock.now_s += 0.5
            progress.waiting()
        stream(6.0)
    assert "waiting for a frame" in caplog.messages
    rates = [
        float(message.split("; ")[1].split(" frames/s")[0])
        for message in caplog.messages
        if "frames/s" in message
    ]
    # No line counts frames of before the silence, nor more than a source of 30 Hz gives.
    assert rates
    assert max(rates) <= 30.5


def test_what_is_only_recorded_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    clock, source = FakeClock(), source_of()
    recording = Recorded(Path("a.mcap"), (Path("a.mcap"),), frames=40, lost=2)
    progress = Progress(source, recorder_of(recording), clock=clock)
    with caplog.at_level(logging.INFO, "nurbseg"):
        for read in (30, 90):
            source.status = Status(read=read)
            clock.now_s += 3.0
            progress.recorded()
    assert caplog.messages == ["90 read, 40 recorded, 2 lost"]


def test_frames_that_are_all_damaged_are_no_silence(caplog: pytest.LogCaptureFixture) -> None:
    clock = FakeClock()
    source = source_of()
    progress = Progress(source, recorder_of(), clock=clock)
    with caplog.at_level(logging.INFO, "nurbseg"):
        for damaged in (7, 19, 19):
            source.status = Status(damaged=damaged)
            clock.now_s += 6.0
            progress.waiting()
    assert caplog.messages == [
        "no frame, but 7 damaged ones in 5 s",
        "no frame, but 12 damaged ones in 5 s",
        "waiting for a frame",
    ]


def test_one_segment_is_singular(caplog: pytest.LogCaptureFixture, small_result: FrameResult) -> None:
    with caplog.at_level(logging.INFO, "nurbseg"):
        Progress(source_of(), recorder_of()).segmented(small_result.frame, 1, {})
    assert caplog.messages == ["frame 0 (synthetic-000000): 1 segment in 0 ms"]


class Line:
    """A status line that keeps what it shows."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def show(self, text: str) -> None:
        self.shown.append(text)


def test_the_status_line_shows_rate_latency_objects_drops_and_recording(
    caplog: pytest.LogCaptureFixture, small_result: FrameResult
) -> None:
    clock, line = FakeClock(), Line()
    path = Path("a.mcap")
    recording = Recorded(path, (path,), seconds=4.0, written_mb=12.0, room_mb=1800.0)
    source, recorder = source_of(damaged=4), recorder_of()
    source.replaced = 2
    told: list[RunState] = []
    name = "a_recording_with_a_long_name.mcap"
    progress = Progress(source, recorder, cast(StatusLine, line), name, tell=told.append, clock=clock)
    elapsed_ms = {"capture_to_labels": 41.7}
    with caplog.at_level(logging.INFO, "nurbseg"):
        for late in range(50):
            clock.now_s += 0.2
            progress.segmented(small_result.frame, 9, elapsed_ms, objects=4, late=late)
            progress.draw()
        assert line.shown[-1] == (
            "a_recording_with_a_long_ | frame 0 | 5.0 frames/s, 42 ms | nurbseg mse T 1 | 4 objects"
            " | 6 dropped, 49 late"
        )
        # Every 0.25 s at most: after every second frame.
        assert len(line.shown) == 25
        recorder.recording = recording
        clock.now_s += 0.3
        state = RunState(SegmentationConfig(metric="vgc", ratio_max=0.9), paused=True)
        progress.draw(lambda: state)
        for _ in range(2):
            progress.segmented(small_result.frame, 9, elapsed_ms)
            clock.now_s += 0.1
        recorder.recording = replace(recording, ended=True)
        clock.now_s += 2.5
        progress.waiting()
        progress.draw(RunState)
        times = len(told)
        clock.now_s += 0.2
        progress.draw()
        assert len(told) == times
        progress.end()
    # 12 MB in 4 s; 1800 MB at 3 MB/s are 10 minutes.
    recorded = "rec 4.0 s, 12.0 MB, 3.0 MB/s, 10 min left"
    assert line.shown[-2:] == [
        f"a_recording_with_a_long_ | {recorded} | frame 0 | paused | nurbseg vgc T 0.9 | 4 objects"
        " | 6 dropped, 49 late",
        "a_recording_with_a_long_ | recording stopped | frame 0 | waiting for a frame | nurbseg mse T 1"
        " | 9 segments | 6 dropped",
    ]
    assert (told[-2].paused, told[-2].ended, told[-1].ended) == (False, False, True)
    # Every 0.1 s at most, and only what has changed.
    assert [" | ".join(each.status) for each in told[-3:-1]] == line.shown[-2:]
    assert not any(one == other for one, other in pairwise(told))
    assert caplog.messages == ["frame 0 (synthetic-000000): 9 segments in 0 ms"]
