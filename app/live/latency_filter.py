"""Latency filter: which results come too late to be shown as live."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)

#: However slow the computer: something is shown this often, seconds.
_LONGEST_GAP_S = 1.0


class LatencyFilter:
    """Holds back results that are older than allowed, but never all of them, and counts them in `held_back`.

    The age counts when a frame's labels are ready; any is allowed where `age_max_ms` is 0.
    """

    def __init__(self, age_max_ms: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.held_back = 0
        self._age_max_ms = age_max_ms
        self._clock = clock
        self._shown_s: float | None = None
        self._said = False

    def passes(self, age_ms: float) -> bool:
        """Say whether a result of this age is to be shown, and take note of it.

        The first one always is, and one that is too old where nothing was shown for a second.
        """
        now_s = self._clock()
        if self._age_max_ms > 0 and age_ms > self._age_max_ms and self._shown_s is not None:
            if now_s - self._shown_s < _LONGEST_GAP_S:
                self.held_back += 1
                return False
            if not self._said:
                self._said = True
                _log.warning(
                    "labels come %.0f ms after their frame; of frames over %g ms, one per second is shown",
                    age_ms,
                    self._age_max_ms,
                )
        self._shown_s = now_s
        return True
