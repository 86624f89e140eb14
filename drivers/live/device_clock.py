"""Notices a camera's clock that runs at another rate than the computer's, and stands in for it."""

import logging
import math
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)

#: The device's time may be ahead by this share and so much more, seconds: images wait to be read.
_SHARE, _SLACK_S = 0.25, 0.5
#: A clock is slow below this share of real time: it counts other units, or nothing. A camera that a busy
#: computer slows down has less time, too, and its own time is right.
_SLOW_SHARE = 0.05
#: Frames after which a slow clock is known, and jumps after which a clock is wrong.
_FRAMES, _JUMPS = 10, 3


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
        self._device_us = math.inf
        self._given_us = self._jumps = 0
        self._host_s = 0.0
        self._begin()

    def timestamp_us(self, device_us: int) -> int:
        """Return the timestamp of a frame that has just come, of which the device says `device_us`."""
        host_s = self._clock()
        last_us, self._device_us = self._device_us, device_us
        step_s, self._host_s = host_s - self._host_s, host_s
        is_next = device_us >= last_us
        if is_next and not self.is_wrong:
            self._compare((device_us - last_us) * 1e-6, step_s)
        if self.is_wrong:
            self._given_us += max(1, round(step_s * 1e6))
        elif is_next:
            self._given_us = max(self._given_us, device_us + self._offset_us)
        else:
            self._begin()
            self._given_us = device_us
        return self._given_us

    def _begin(self) -> None:
        """Count the time on both clocks from here on, and the real time without pauses."""
        self._offset_us = 0
        self._device_s = self._real_s = self._busy_s = 0.0

    def _compare(self, device_step_s: float, real_step_s: float) -> None:
        self._device_s += device_step_s
        self._real_s += real_step_s
        self._busy_s += min(real_step_s, _SLACK_S / _FRAMES)
        if self._busy_s >= _SLACK_S and self._device_s < _SLOW_SHARE * self._busy_s:
            self._take_over(self._device_s / self._real_s)
        elif self._device_s > (1 + _SHARE) * self._real_s + _SLACK_S:
            if device_step_s <= (1 + _SHARE) * real_step_s + _SLACK_S:
                self._take_over(self._device_s / self._real_s)
                return
            self._jumps += 1
            if self._jumps >= _JUMPS:
                self._take_over(device_step_s / max(real_step_s, 1e-6))
                return
            self._offset_us -= round((device_step_s - real_step_s) * 1e6)
            self._device_s -= device_step_s - real_step_s
            _log.warning("%s: its clock jumps by %.1f s; the time goes on", self._name, device_step_s)

    def _take_over(self, rate: float) -> None:
        self.is_wrong = True
        _log.warning(
            "%s: its clock runs %.3g times as fast as real time; frames get the computer's time instead",
            self._name,
            rate,
        )
