"""The pacing of a replay."""

import logging
import math
import time
from collections.abc import Callable

from nurbseg.common.errors import DriverError, EndOfRecordingError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.source import FrameSource, Wrapped

_log = logging.getLogger(__name__)

#: Longest wait for the next frame of a replay, seconds; timestamps that jump further are damaged, or the
#: camera was away.
_LONGEST_PAUSE_S = 10.0
#: A step of the timestamps, seconds, that is no jump however slow the replay is.
_USUAL_STEP_S = 1.0
#: Jumps of timestamps that are logged; further ones are only counted.
_JUMPS_NAMED_MAX = 20


class Paced(Wrapped):
    """Replays another source at its recorded rate, or a multiple of it.

    A frame is returned at ``start + (its timestamp - first timestamp) / speed``. These moments are
    absolute, so that delays do not add up; a late reader gets the frames it missed without a wait. Where
    the timestamps go back, or jump forward by more than a second and by more than the replay would wait for
    `_LONGEST_PAUSE_S`, the log says so, and the replay goes on one frame's time later, or after that pause. A
    single timestamp that is wrong, from which the next one comes back, counts as one frame's time.

    Parameters
    ----------
    source : FrameSource
        Borrowed and closed with this one.
    speed : float
        Multiple of the recorded rate, over 0.
    clock : callable
        Monotonic seconds.
    sleep : callable
        Waits that many seconds.

    Raises
    ------
    ValueError
        If `speed` is not over 0.
    """

    def __init__(
        self,
        source: FrameSource,
        speed: float = 1.0,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__(source)
        self._clock = clock
        self._sleep = sleep
        self._start_s: float | None = None
        self.speed = speed
        self._first_ns = 0
        self._last_ns = 0
        self._period_ns = 0  # the last one that was no jump
        self._jumps = self._since_start = 0
        self._waiting: RGBDFrame | None = None  # read, but not due within the last time limit
        self._ahead: RGBDFrame | DriverError | None = None  # read, or raised, after that one

    @property
    def speed(self) -> float:
        """Multiple of the recorded rate."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not 0 < speed < math.inf:
            raise ValueError(f"speed: expected more than 0, got {speed}")
        self._speed = speed
        self.restart()

    def restart(self) -> None:
        """Make the next frame due now, and time those after it from it: after a pause."""
        self._start_s = None

    def _read(self, timeout_s: float) -> RGBDFrame:
        if self._waiting is None:
            self._waiting = self._next(timeout_s)
            self._last_ns = self._moment_ns(self._waiting)
            self._since_start += 1
        if self._start_s is None:
            self._start_s = self._clock()
            self._first_ns = self._last_ns
        due_s = self._start_s + (self._last_ns - self._first_ns) * 1e-9 / self._speed
        wait_s = due_s - self._clock()
        if wait_s > 0:
            self._sleep(min(wait_s, timeout_s))
        if wait_s > timeout_s:
            raise FrameTimeoutError(f"the next frame is due in {wait_s - timeout_s:.1f} s")
        frame, self._waiting = self._waiting, None
        return frame

    def _next(self, timeout_s: float) -> RGBDFrame:
        ahead, self._ahead = self._ahead, None
        if isinstance(ahead, DriverError):
            raise ahead
        return self._source.read(timeout_s) if ahead is None else ahead

    def _moment_ns(self, frame: RGBDFrame) -> int:
        """Return when a frame is due, as a timestamp; moves the first one where the frame's jumps."""
        time_ns = frame.timestamp_ns
        step_ns = time_ns - self._last_ns
        pause_ns = round(_LONGEST_PAUSE_S * self._speed * 1e9)
        longest_ns = max(pause_ns, round(_USUAL_STEP_S * 1e9))
        if self._start_s is None:
            self._since_start = 0
            return time_ns
        if 0 <= step_ns <= longest_ns:
            self._period_ns = step_ns
            return time_ns
        if self._ahead is None:
            try:
                self._ahead = self._source.read(0.0)
            except DriverError as err:
                self._ahead = err
        following_ns = self._ahead.timestamp_ns if isinstance(self._ahead, RGBDFrame) else time_ns
        expected_ns = self._period_ns
        if 0 < following_ns - self._last_ns <= longest_ns:
            self._say_jump(frame, "is that of no frame near it")
            return self._last_ns + min(expected_ns, following_ns - self._last_ns)
        if step_ns < 0:
            self._say_jump(frame, f"goes back by {-step_ns * 1e-9:.3f} s; the replay continues at once")
        elif self._since_start == 1:
            # The first one was wrong rather than this one late.
            self._say_jump(
                frame, f"jumps by {step_ns * 1e-9:.0f} s from the first; the replay continues at once"
            )
        else:
            pause = f"the replay continues after {_LONGEST_PAUSE_S:.0f} s"
            self._say_jump(frame, f"jumps by {step_ns * 1e-9:.0f} s; {pause}")
            expected_ns = pause_ns
        self._first_ns += step_ns - expected_ns
        return time_ns

    def _say_jump(self, frame: RGBDFrame, what: str) -> None:
        self._jumps += 1
        if self._jumps <= _JUMPS_NAMED_MAX:
            _log.warning("frame %d: the timestamp %s", frame.index, what)

    def _seek(self, index: int) -> None:
        self._waiting = self._ahead = None
        self.restart()
        super()._seek(index)

    def skip(self, frames: int) -> int:
        """Skip the next frames without waiting until they are due."""
        passed = 0
        for held in ("_waiting", "_ahead"):
            # What was raised ahead is a damaged frame, or will be raised again.
            if passed < frames and getattr(self, held) is not None:
                passed += not isinstance(getattr(self, held), EndOfRecordingError | FrameTimeoutError)
                setattr(self, held, None)
        return passed + self._source.skip(frames - passed)
