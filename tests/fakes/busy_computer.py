"""How much slower a camera must be for a computer to keep up that other programs are busy on."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

#: Programs that run or wait for each processor from which on a camera of full rate cannot be kept up with.
_LOAD_MAX = 1.5


def slowdowns() -> Iterator[int]:
    """Yield how many times slower a camera is to be in each try: 1 unless other programs are busy.

    Its timestamps are those of its full rate; only its clock is slow. What loses frames for a reason of its
    own loses them at any speed.
    """
    for attempt in range(3):
        running = os.getloadavg()[0]
        if attempt:
            # The average rises late: what took the processor from the last try may not be in it yet.
            running = max(running, float(Path("/proc/loadavg").read_text().split()[3].partition("/")[0]))
        load = running / (os.cpu_count() or 1)
        yield 1 if load <= _LOAD_MAX else math.ceil(load) * 2**attempt


__all__ = ["slowdowns"]
