"""Frames that a program puts in come out as a camera's."""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import replace

import pytest
from scripted_source import CALIBRATION, small_frame

from nurbseg import FramesSource
from nurbseg.common.errors import DriverError, EndOfRecordingError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.source import FrameSource
from nurbseg.testing import SourceContract


def value(frame: RGBDFrame) -> int:
    """The pixel that `small_frame` numbers."""
    return int(frame.depth_mm[0, 0])


class TestContract(SourceContract):
    def open(self) -> FrameSource:
        source = FramesSource(CALIBRATION)
        self.putting = threading.Thread(target=self._put, args=(source,))
        self.putting.start()
        return source

    def _put(self, source: FramesSource) -> None:
        for number in range(1, 3000):
            frame = small_frame(number)
            try:
                source.put(replace(frame, depth_mm=frame.depth_mm + 1000, color=frame.color + 1))
            except DriverError:
                return
            time.sleep(0.005)


def test_a_slow_loop_gets_the_newest_frame_and_one_of_every_frame_all() -> None:
    with FramesSource(CALIBRATION) as source:
        every = source.reader(every=True)
        for reader in (source, every):
            # It takes part from its first read on.
            with pytest.raises(FrameTimeoutError):
                reader.read(0)
        source.put(small_frame(0))
        assert source.read(5).index == every.read(5).index == 0
        taken = []
        for number in range(1, 6):
            source.put(small_frame(number))
            taken.append(every.read(5))
        source.end()
        assert [value(each) for each in taken] == [value(small_frame(n)) for n in range(1, 6)]
        assert [each.index for each in taken] == [1, 2, 3, 4, 5]
        assert source.latest(10_000).index == 5
        assert [frame.index for frame in source] == [5] and source.missed == 4
        with pytest.raises(EndOfRecordingError):
            every.read(5)


def test_what_was_put_before_the_end_is_read_and_nothing_after_it() -> None:
    source = FramesSource(CALIBRATION)
    stamped = replace(small_frame(3), timestamp_ns=77, index=9)
    source.put(stamped)
    source.put(replace(stamped, timestamp_ns=0))
    source.end()
    with pytest.raises(DriverError, match="no frame can be put any more"):
        source.put(stamped)
    before_ns = time.time_ns()
    with source.reader(every=True) as reader:
        first, second = reader
    assert (first.index, first.timestamp_ns, second.index) == (0, 77, 1)
    assert abs(second.timestamp_ns - before_ns) < 60e9
    source.close()


def test_a_silent_program_is_said_and_a_loop_waits_as_long_as_told() -> None:
    with FramesSource(CALIBRATION, silence_s=0.05) as source:
        with pytest.raises(FrameTimeoutError, match=r"the program's frames: no frame within 0\.05 s"):
            next(iter(source))
        with pytest.raises(FrameTimeoutError, match=r"within 0\.01 s"):
            source.read(0.01)
        source.put(small_frame(1))
        assert source.read(5).index == 0
    with pytest.raises(DriverError):
        source.read()
    with pytest.raises(DriverError, match="closed"):
        source.put(small_frame(1))


def test_frames_of_several_threads_are_numbered_in_the_order_in_which_they_come(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source = FramesSource(CALIBRATION)
    came: list[int] = []

    def put(frame: RGBDFrame) -> bool:
        came.append(frame.index)
        return True

    monkeypatch.setattr(source._inbox.queue, "put", put)

    def put_many() -> None:
        for _ in range(500):
            source.put(small_frame(0))

    threads = [threading.Thread(target=put_many) for _ in range(4)]
    interval_s = sys.getswitchinterval()
    try:
        sys.setswitchinterval(1e-6)
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30.0)
    finally:
        sys.setswitchinterval(interval_s)
        source.close()
    assert came == list(range(2000))
