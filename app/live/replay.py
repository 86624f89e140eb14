"""Replays that are repeated or limited."""

import time
from collections.abc import Callable
from dataclasses import replace

from nurbseg.common.errors import EndOfRecordingError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.datasets.sequence import FRAME_INTERVAL_NS
from nurbseg.drivers.source import FrameSource, Wrapped

#: Longest time between two frames that counts, nanoseconds: a replay waits no longer.
_LONGEST_STEP_NS = 10_000_000_000


class Looped(Wrapped):
    """A recording that is repeated while `repeats` is set; frame numbers and timestamps keep increasing.

    `source` is the first pass; `reopen` opens each further pass.
    """

    def __init__(
        self, source: FrameSource, reopen: Callable[[], FrameSource], *, repeats: bool = True
    ) -> None:
        super().__init__(source)
        self.repeats = repeats
        self._reopen = reopen
        self._last: RGBDFrame | None = None
        # Until it is known from two frames.
        self._period_ns = FRAME_INTERVAL_NS
        self._index_offset = 0
        self._time_offset_ns = 0
        #: Number of each pass's first frame in the recording, and the length of a pass; 0 in the first pass.
        self._first = self._length = 0
        #: Number and time of the first frame of the next pass.
        self._seam: tuple[int, int] | None = None

    def _read(self, timeout_s: float) -> RGBDFrame:
        try:
            frame = self._source.read(timeout_s)
        except EndOfRecordingError:
            if not self.repeats:
                raise
            self._begin_again()
            frame = self._source.read(timeout_s)
        if self._seam is not None:
            index, timestamp_ns = self._seam
            self._first, self._length = frame.index, index - frame.index - self._index_offset
            self._index_offset = index - frame.index
            self._time_offset_ns = timestamp_ns - frame.timestamp_ns
            self._seam = None
        if self._index_offset:
            index, timestamp_ns = frame.index + self._index_offset, frame.timestamp_ns + self._time_offset_ns
            frame = replace(frame, index=index, timestamp_ns=timestamp_ns)
        last, self._last = self._last, frame
        if last is not None and frame.index == last.index + 1 and frame.timestamp_ns > last.timestamp_ns:
            self._period_ns = frame.timestamp_ns - last.timestamp_ns
        return frame

    def _begin_again(self) -> None:
        if self._last is None:
            raise EndOfRecordingError("the recording has no frame to repeat")
        self._seam = self._last.index + 1, self._last.timestamp_ns + self._period_ns
        self._last = None
        self._source.close()
        self._source = self._reopen()

    def _seek(self, index: int) -> None:
        """Seek to a frame by its number in any pass; frames then have their numbers in the recording."""
        if self._length and index >= self._first:
            index = self._first + (index - self._first) % self._length
        self._source.seek(index)
        self._index_offset = self._time_offset_ns = 0
        self._seam = None


class Limited(Wrapped):
    """A source that ends after some frames, except damaged ones, or some time, both after `delay_s`.

    Time is that of the frames' timestamps and, for a live source, also that of `clock` (monotonic seconds),
    so that a camera without frames ends, too.
    """

    def __init__(
        self,
        source: FrameSource,
        *,
        frames: int | None = None,
        duration_s: float | None = None,
        delay_s: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(source)
        self.live = source.live
        self._frames_left = frames
        self._duration_s = duration_s
        self._delay_ns = round(delay_s * 1e9)
        self._clock = clock
        self._began_s: float | None = None
        self._last_ns: int | None = None
        self._elapsed_ns = 0

    def _read(self, timeout_s: float) -> RGBDFrame:
        if self._frames_left is not None and self._frames_left <= 0:
            raise EndOfRecordingError("all requested frames were read")
        if self._began_s is None:
            self._began_s = self._clock()
        if self.live and self._is_over(self._clock() - self._began_s):
            raise EndOfRecordingError("the requested duration is over")
        frame = self._source.read(timeout_s)
        if self._last_ns is not None:
            # A camera's clock is reset when OpenNI2's recorder starts; a longer time is a wrong stamp.
            self._elapsed_ns += min(max(0, frame.timestamp_ns - self._last_ns), _LONGEST_STEP_NS)
        self._last_ns = frame.timestamp_ns
        if self._is_over(self._elapsed_ns * 1e-9):
            raise EndOfRecordingError("the requested duration is over")
        if self._frames_left is not None and self._elapsed_ns >= self._delay_ns:
            self._frames_left -= 1
        return frame

    def _is_over(self, elapsed_s: float) -> bool:
        return self._duration_s is not None and elapsed_s >= self._duration_s + self._delay_ns * 1e-9

    def _seek(self, index: int) -> None:
        # The time skipped does not count.
        self._last_ns = None
        super()._seek(index)
