"""The player of a source: its speed, its limits and passes, and pauses, steps and jumps in it."""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import EndOfRecordingError, FrameTimeoutError, RecordingFormatError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.source import FRAME_INTERVAL_NS, FrameSource, Wrapped

_log = logging.getLogger(__name__)

#: Longest wait for the next frame of a replay, seconds.
_LONGEST_PAUSE_S = 10.0
#: A step of the timestamps, seconds, that is no leap however slow the replay is.
_USUAL_STEP_S = 1.0
#: Leaps of timestamps that are logged.
_LEAPS_NAMED_MAX = 20
#: Longest wait in a pause, seconds.
_PAUSE_S = 0.05


class Player(Wrapped):
    """Plays a recording at a speed, once or again and again; or a camera, to which only the limits apply.

    At a speed, a frame is returned at ``start + (its timestamp - first timestamp) / speed``. These moments
    are absolute, so that delays do not add up; a late reader gets the frames it missed without a wait. Where
    the timestamps go back, the replay continues one frame's time later; where they leap forward by more than
    a second and than it would wait for `_LONGEST_PAUSE_S`, after that pause. The log reports both.

    In later passes, frame numbers and timestamps keep increasing. After a seek, frames have the numbers of
    the recording, and `RGBDFrame.jumps` is higher.

    Parameters
    ----------
    source : FrameSource
        What is played; closed with this one.
    name : str
        What errors call it.
    reopen : callable, optional
        Opens the recording for a further pass.
    speed : float, optional
        Multiple of the recorded rate, over 0; None for as fast as it is read.
    loop : bool
        Whether there is a further pass at the end.
    start : int
        Frames skipped at the beginning of each pass.
    frames : int, optional
        The end comes after so many, except damaged ones and those within `delay_s`.
    duration_s : float, optional
        The end comes so long after `delay_s`, seconds of the timestamps; of a camera also of the clock, so
        that one without frames ends, too.
    delay_s : float
        Time before frames and duration count, seconds.
    clock : callable
        Monotonic seconds.
    sleep : callable
        Waits that many seconds.

    Raises
    ------
    ValueError
        If `speed` is not over 0.
    RecordingFormatError
        If no frame is left after `start`.

    Attributes
    ----------
    loop : bool or None
        Whether there is a further pass at the end; None if there cannot be.
    paused : bool
        Whether only frames stepped or sought to are read, each at once; a camera is read on.
    jumps : int
        How often `seek` was called.
    """

    def __init__(
        self,
        source: FrameSource,
        *,
        name: str = "the recording",
        reopen: Callable[[], FrameSource] | None = None,
        speed: float | None = None,
        loop: bool = False,
        start: int = 0,
        frames: int | None = None,
        duration_s: float | None = None,
        delay_s: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(source)
        self.live = source.live
        if self.live:
            reopen, speed, start = None, None, 0
        self.loop = None if reopen is None else loop
        self.paused = False
        self.jumps = 0
        self._speed: float | None = None
        if speed is not None:
            self.speed = speed
        self._name, self._reopen, self._start = name, reopen, start
        self._clock, self._sleep = clock, sleep
        #: Where to go next, and in a pause how many frames are still to be read.
        self._target: int | None = None
        self._to_read = 0
        self._frames_left = math.inf if frames is None else frames
        self._delay_ns = round(1e9 * delay_s)
        self._end_ns = math.inf if duration_s is None else round(1e9 * duration_s) + self._delay_ns
        self._began_s: float | None = None
        self._elapsed_ns = 0
        self._last: RGBDFrame | None = None
        # Until it is known from two frames.
        self._period_ns = FRAME_INTERVAL_NS
        self._index_offset = self._time_offset_ns = 0
        #: Number of each pass's first frame in the recording, and the length of a pass; 0 in the first pass.
        self._first = self._length = 0
        #: Number and time of the first frame of the next pass.
        self._seam: tuple[int, int] | None = None
        self._due_from_s: float | None = None
        self._paced: float | None = None  # the speed for which this holds
        self._due_ns = self._last_ns = self._leaps = 0
        self._usual_ns = FRAME_INTERVAL_NS  # the last step of the timestamps that was no leap
        self._waiting: RGBDFrame | None = None  # read, but not due within the last time limit
        self._skip_start()

    @property
    def speed(self) -> float | None:
        """Multiple of the recorded rate; None if frames come as fast as they are read."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not 0 < speed < math.inf:
            raise ValueError(f"speed: expected more than 0, got {speed}")
        self._speed = speed

    def step(self) -> None:
        """Pause, and read one more frame."""
        self.paused = True
        self._to_read += 1

    def _seek(self, index: int) -> None:
        """Go to a frame by its number in any pass; in a pause, it is the only one read."""
        self.jumps += 1
        self._target = index
        self._to_read = int(self.paused)

    def _read(self, timeout_s: float) -> RGBDFrame:
        target, self._target = self._target, None
        held = self.paused and not self._to_read and not self.live
        if target is not None:
            self._go_to(target)
        if self.paused or target is not None or self._paced != self._speed:
            # The next frame is due now, and those after it are timed from it.
            self._due_from_s, self._paced = None, self._speed
        if held:
            self._sleep(min(timeout_s, _PAUSE_S))
            raise FrameTimeoutError("the replay is paused")
        frame = self._following(timeout_s) if self._paced is None else self._when_due(timeout_s, self._paced)
        self._to_read = max(0, self._to_read - 1)
        return frame

    def _go_to(self, index: int) -> None:
        if self._length and index >= self._first:
            index = self._first + (index - self._first) % self._length
        self._source.seek(index)
        self._index_offset = self._time_offset_ns = 0
        self._seam = self._waiting = None

    def _pass_frame(self) -> None:
        """Skip one frame without waiting until it is due."""
        waiting, self._waiting = self._waiting, None
        if waiting is None:
            self._following(_USUAL_STEP_S)

    def _when_due(self, timeout_s: float, speed: float) -> RGBDFrame:
        """Return the next frame when it is due."""
        if self._waiting is None:
            self._waiting = self._following(timeout_s)
            self._due_ns += self._step_ns(self._waiting, speed)
        if self._due_from_s is None:
            self._due_from_s, self._due_ns = self._clock(), 0
        wait_s = self._due_from_s + self._due_ns * 1e-9 / speed - self._clock()
        if wait_s > 0:
            self._sleep(min(wait_s, timeout_s))
        if wait_s > timeout_s:
            raise FrameTimeoutError(f"the next frame is due in {wait_s - timeout_s:.1f} s")
        frame, self._waiting = self._waiting, None
        return frame

    def _step_ns(self, frame: RGBDFrame, speed: float) -> int:
        """Return the recording's time between the last frame and this one; leaps are cut down."""
        step_ns, self._last_ns = frame.timestamp_ns - self._last_ns, frame.timestamp_ns
        pause_ns = round(1e9 * _LONGEST_PAUSE_S * speed)
        if self._due_from_s is None:
            return 0
        if 0 <= step_ns <= max(pause_ns, 1e9 * _USUAL_STEP_S):
            self._usual_ns = step_ns
            return step_ns
        leap = f"jumps by {step_ns * 1e-9:.0f} s; the replay continues after {_LONGEST_PAUSE_S:.0f} s"
        if step_ns < 0:
            leap = f"goes back by {-step_ns * 1e-9:.3f} s; the replay continues at once"
        self._leaps += 1
        if self._leaps <= _LEAPS_NAMED_MAX:
            _log.warning("frame %d: the timestamp %s", frame.index, leap)
        return self._usual_ns if step_ns < 0 else pause_ns

    def _following(self, timeout_s: float) -> RGBDFrame:
        """Read the next frame within the limits, with rising numbers and timestamps from pass to pass."""
        if self._frames_left <= 0:
            raise EndOfRecordingError("all requested frames were read")
        if self._began_s is None:
            self._began_s = self._clock()
        if self.live and 1e9 * (self._clock() - self._began_s) >= self._end_ns:
            raise EndOfRecordingError("the requested duration is over")
        frame = self._of_any_pass(timeout_s)
        last, self._last = self._last, frame
        if last is None:
            # A camera may take long to start.
            self._began_s = self._clock()
        elif frame.jumps == last.jumps:
            step_ns = frame.timestamp_ns - last.timestamp_ns
            if frame.index == last.index + 1 and step_ns > 0:
                self._period_ns = step_ns
            # A camera's clock is reset when OpenNI2's recorder starts; a longer time is a wrong stamp.
            self._elapsed_ns += min(max(0, step_ns), round(1e9 * _LONGEST_PAUSE_S))
        if self._elapsed_ns >= self._end_ns:
            raise EndOfRecordingError("the requested duration is over")
        if self._elapsed_ns >= self._delay_ns:
            self._frames_left -= 1
        return frame

    def _of_any_pass(self, timeout_s: float) -> RGBDFrame:
        try:
            frame = self._source.read(timeout_s)
        except EndOfRecordingError:
            if not self.loop or self._reopen is None:
                raise
            if self._last is None or self._seam is not None:
                raise EndOfRecordingError("the recording has no frame to repeat") from None
            self._seam = self._last.index + 1, self._last.timestamp_ns + self._period_ns
            self._source.close()
            self._source = self._reopen()
            self._skip_start()
            frame = self._source.read(timeout_s)
        if self._seam is not None:
            index, timestamp_ns = self._seam
            self._first, self._length = frame.index, index - frame.index - self._index_offset
            self._index_offset = index - frame.index
            self._time_offset_ns = timestamp_ns - frame.timestamp_ns
            self._seam = None
        if not self._index_offset and not self.jumps:
            return frame
        return replace(
            frame,
            index=frame.index + self._index_offset,
            timestamp_ns=frame.timestamp_ns + self._time_offset_ns,
            jumps=self.jumps,
        )

    def _skip_start(self) -> None:
        with closed_on_error(self._source.close):
            passed = self._source.skip(self._start)
            if passed < self._start:
                raise RecordingFormatError(
                    f"{self._name}: has {passed} frames, so none is left after --start {self._start}"
                )
