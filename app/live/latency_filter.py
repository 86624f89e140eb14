"""Latency filter: holds back results that are too late to be shown live."""

import logging
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)

#: Longest time without a result shown, seconds.
_LONGEST_GAP_S = 1.0


class LatencyFilter:
    """Holds back results that are older than `age_max_ms`, or none if it is 0, and counts them."""

    def __init__(self, age_max_ms: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.held_back = 0
        self._age_max_ms = age_max_ms
        self._clock = clock
        self._shown_s: float | None = None
        self._said = False

    def passes(self, age_ms: float) -> bool:
        """Return whether to show a result of this age: the first always, later ones at least every second."""
        now_s = self._clock()
        if self._age_max_ms > 0 and age_ms > self._age_max_ms and self._shown_s is not None:
            if now_s - self._shown_s < _LONGEST_GAP_S:
                self.held_back += 1
                return False
            if not self._said:
                self._said = True
                _log.warning(
                    "labels come %.0f ms after their frame; of those over %g ms only one per second is shown",
                    age_ms,
                    self._age_max_ms,
                )
        self._shown_s = now_s
        return True
