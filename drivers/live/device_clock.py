"""Notices a camera's clock that runs at another rate than the computer's, and stands in for it."""

import logging
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)

#: The device's time may be ahead by this share and so much more, seconds: images wait to be read.
_SHARE, _SLACK_S = 0.25, 0.5
#: A clock is slow below this share of real time: it counts other units, or nothing. A camera that a busy
#: computer slows down has less time, too, and its own time is right.
_SLOW_SHARE = 0.05
#: Frames after which a rate is known, and steps of a clock that are too long after which it is wrong anyway.
_FRAMES, _JUMPS = 10, 3
#: A longer time between two frames says nothing of the clock: the camera or its reader paused, seconds.
_PAUSE_S = 0.5


class DeviceClock:
    """Turns the timestamps of a camera's frames, microseconds, into ones that pass as fast as real time.

    They stay as they are as long as the device's clock agrees with the computer's. Some drivers count other
    units than microseconds: that is noticed within a second of frames and said, and from then on the
    computer's time counts. A single jump forward is bridged. After a step back, as when a recorder resets the
    clock, the device's own time counts again.

    Parameters
    ----------
    name : str
        What the device is called.
    clock : callable
        Monotonic seconds.
    """

    def __init__(self, name: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        #: Whether the device's clock was found to be wrong.
        self.is_wrong = False
        self._name, self._clock = name, clock
        self._device_us: int | None = None
        self._given_us = self._offset_us = 0
        self._host_s = 0.0
        self._jumps = 0
        #: Since the two clocks were last compared from: the time that passed on each, and the frames.
        self._device_s = self._real_s = 0.0
        self._frames = 0
        #: What the device may catch up after a pause.
        self._late_s = 0.0

    def timestamp_us(self, device_us: int) -> int:
        """Return the timestamp of a frame that has just come, of which the device says `device_us`."""
        host_s = self._clock()
        last_us, self._device_us = self._device_us, device_us
        step_s, self._host_s = host_s - self._host_s, host_s
        if last_us is None:
            self._given_us = device_us
        elif self.is_wrong:
            self._given_us += max(1, round(step_s * 1e6))
        elif device_us < last_us:
            self._begin_comparison()
            self._offset_us = 0
            self._given_us = device_us
        else:
            self._compare((device_us - last_us) * 1e-6, step_s)
            self._given_us = max(self._given_us, device_us + self._offset_us)
        return self._given_us

    def _begin_comparison(self) -> None:
        self._device_s = self._real_s = 0.0
        self._frames = 0

    def _compare(self, device_step_s: float, real_step_s: float) -> None:
        self._device_s += device_step_s
        self._real_s += real_step_s
        self._frames += 1
        is_fast = self._device_s > (1 + _SHARE) * self._real_s + _SLACK_S + self._late_s
        is_slow = self._real_s > _SLACK_S and self._device_s < _SLOW_SHARE * self._real_s
        if real_step_s > _PAUSE_S and not is_fast:
            self._late_s = max(0.0, self._late_s + self._real_s - self._device_s)
            self._begin_comparison()
            return
        before_s = self._real_s - real_step_s
        was_fast = self._device_s - device_step_s > (1 + _SHARE / 2) * before_s + self._late_s
        if is_fast:
            self._jumps += 1
            self._offset_us -= round((device_step_s - real_step_s) * 1e6)
        if self._frames >= _FRAMES and ((is_fast and was_fast) or is_slow):
            self._take_over(self._device_s / max(self._real_s, 1e-6))
        elif is_fast and self._jumps >= _JUMPS:
            self._take_over(device_step_s / max(real_step_s, 1e-6))
        elif is_fast:
            _log.warning("%s: its clock jumps by %.1f s; the time goes on", self._name, device_step_s)
            self._begin_comparison()

    def _take_over(self, rate: float) -> None:
        self.is_wrong = True
        _log.warning(
            "%s: its clock runs %.3g times as fast as real time; frames get the computer's time instead",
            self._name,
            rate,
        )
