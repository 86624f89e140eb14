"""The clock by which tests hold programs to time limits."""

import os
import time
from pathlib import Path

import pytest
from fair_clock import FairClock


def _burn(seconds: float) -> None:
    end_s = time.process_time() + seconds
    while time.process_time() < end_s:
        pass


def test_waiting_counts_in_full() -> None:
    with FairClock() as clock:
        time.sleep(0.5)
    # The thread that wakes up may have to wait for its processor.
    assert clock.elapsed_s > 0.4


def test_computing_counts_as_much_as_it_takes_of_a_processor() -> None:
    if not Path("/proc/self/schedstat").exists():
        pytest.skip("this kernel does not tell how long threads wait for a processor")
    processors = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(processors)})
        busy = ["sh", "-c", "while :; do :; done"]
        rivals = [os.posix_spawn("/bin/sh", busy, os.environ) for _ in range(3)]
        try:
            began_s = time.monotonic()
            with FairClock() as clock:
                _burn(0.5)
            wall_s = time.monotonic() - began_s
        finally:
            for rival in rivals:
                os.kill(rival, 9)
                os.waitpid(rival, 0)
    finally:
        os.sched_setaffinity(0, processors)
    assert wall_s > 1.0
    assert clock.elapsed_s < 1.0
