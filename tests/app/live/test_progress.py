import logging
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from nurbseg.app.live.progress import Progress
from nurbseg.app.result import FrameResult


@dataclass
class Clock:
    now_s: float = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_the_rate_after_a_silence_is_that_of_the_frames_since(
    caplog: pytest.LogCaptureFixture, small_result: FrameResult
) -> None:
    clock = Clock()
    capture: Any = SimpleNamespace(read=0, withheld=0, recording=None, frames=SimpleNamespace(dropped=0))
    progress = Progress(capture, clock=clock)

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
        float(each.split("; ")[1].split(" frames/s")[0]) for each in caplog.messages if "frames/s" in each
    ]
    # No line counts frames of before the silence, nor more than a source of 30 Hz gives.
    assert rates
    assert max(rates) <= 30.5


def test_frames_that_are_only_recorded_are_no_silence(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    recording = SimpleNamespace(frames=40, lost=2)
    capture: Any = SimpleNamespace(withheld=0, recording=recording)
    progress = Progress(capture, clock=clock)
    with caplog.at_level(logging.INFO, "nurbseg"):
        for withheld in (12, 20, 20):
            capture.withheld = withheld
            clock.now_s += 6.0
            progress.waiting()
    assert caplog.messages == [
        "writing is slow: 12 frames recorded only, 40 recorded, 2 lost",
        "writing is slow: 8 frames recorded only, 40 recorded, 2 lost",
        "waiting for a frame",
    ]
