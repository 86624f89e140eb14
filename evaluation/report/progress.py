"""Progress and remaining time of a command."""

import sys
import time
from collections.abc import Callable

#: Time between two lines of a log, seconds.
_LOG_S = 60.0


class Progress:
    """Prints progress on stderr: a bar in a terminal, or else a line from time to time."""

    def __init__(self, unit: str, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._unit = unit
        self._clock_s = clock_s
        self._first: tuple[float, int] | None = None
        self._logged_s = clock_s()

    def __call__(self, done: int, total: int, more: str = "") -> None:
        """Report `done` of `total`; the first call says how much was done before."""
        now_s = self._clock_s()
        began_s, before = self._first = self._first or (now_s, done)
        words = f"{done}/{total} {self._unit}"
        if before < done < total:
            words += f", {_span((now_s - began_s) / (done - before) * (total - done))} left"
        if sys.stderr.isatty():
            filled = round(30 * done / max(total, 1))
            end = "\n" if done == total else ""
            # Clears the rest of a longer line.
            print(f"\r[{'#' * filled:.<30}] {words} {more}\x1b[K", end=end, file=sys.stderr, flush=True)
        elif done == total or now_s - self._logged_s >= _LOG_S:
            self._logged_s = now_s
            print(f"{words} {more}".rstrip(), file=sys.stderr, flush=True)


def _span(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"
