"""What the run is given of the captured frames."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from scripted_source import small_frame

from nurbseg.app.live.capture import Captured
from nurbseg.app.live.control.feed import Feed
from nurbseg.app.live.interruption import Interruption
from nurbseg.drivers.process.bounded_queue import BoundedQueue


def test_frames_that_were_queued_before_a_seek_are_passed_over() -> None:
    frames: BoundedQueue[Captured] = BoundedQueue(10, "wait")
    for index, jumps in ((5, 0), (6, 0), (100, 1), (7, 0), (200, 2), (201, 2)):
        frames.put(Captured(small_frame(index), 0.0, jumps))
    frames.close()
    capture: Any = SimpleNamespace(frames=frames, jumps=2)
    progress: Any = SimpleNamespace(draw=lambda paused: None)
    given = list(Feed(capture, progress, Interruption()).captured())
    assert [each.frame.index for each in given if each is not None] == [200, 201]
