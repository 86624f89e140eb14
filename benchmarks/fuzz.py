"""Fuzzes every reader of recordings, images, calibrations and configurations.

Files of every form, made here, are changed at random and read. Counted are errors that are not typed,
crashes, and files that take over 5 s or 1 GiB; each has a number, which makes it again::

    python benchmarks/fuzz.py --minutes 5
    python benchmarks/fuzz.py --mutant 12345
"""

from __future__ import annotations

import argparse
import faulthandler
import itertools
import random
import re
import resource
import subprocess
import sys
import threading
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "fakes"))
# What makes the corpus for the tests makes it here.
from mutants import forms, mutant, read_mutant

SECONDS_MAX = 5.0
MEMORY_MAX_KIB = 1 << 20
_ADDRESS_SPACE_BYTES = 6 << 30
#: A worker that says nothing for so long is ended.
_SILENCE_S = 60.0


def main() -> None:
    """Fuzz for some minutes and print what came of it; exits with 1 where anything was found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=5.0, help="how long (5)")
    parser.add_argument("--first", type=int, default=0, help="number of the first mutant (0)")
    parser.add_argument("--mutant", type=int, help="make and read this one only")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker or given.mutant is not None:
        numbers = itertools.count(given.first) if given.worker else iter([given.mutant])
        work(numbers)
        return
    end_s = time.monotonic() + 60 * given.minutes
    outcomes: Counter[tuple[str, str]] = Counter()
    number = given.first
    while time.monotonic() < end_s:
        number = watch(number, end_s, outcomes)
    for name in sorted({name for name, _ in outcomes}):
        counts = {word: outcomes[name, word] for word in ("read", "refused", "FOUND")}
        print(f"{name:24}" + "".join(f"{count:>8} {word}" for word, count in counts.items()))
    found = sum(count for (_, word), count in outcomes.items() if word == "FOUND")
    print(f"{outcomes.total()} mutants: {found} untyped, crashed, or over {SECONDS_MAX:.0f} s or 1 GiB")
    sys.exit(found > 0)


def watch(number: int, end_s: float, outcomes: Counter[tuple[str, str]]) -> int:
    """Count what a worker says until the end, or until it ended; return the number it came to."""
    command = [sys.executable, __file__, "--worker", "--first", str(number)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdout is not None
        alarm = threading.Timer(_SILENCE_S, worker.kill)
        alarm.start()
        name = ""
        for line in worker.stdout:
            alarm.cancel()
            words = line.split()
            if words[0] == "begins":
                number, name = int(words[1]), words[2]
                alarm = threading.Timer(_SILENCE_S, worker.kill)
                alarm.start()
                continue
            outcomes[name, words[0]] += 1
            if words[0] == "FOUND":
                print(f"mutant {number} of {name}: {line.partition(' ')[2].strip()}", flush=True)
            number += 1
            if time.monotonic() > end_s:
                worker.kill()
                return number
        alarm.cancel()
    outcomes[name, "FOUND"] += 1
    print(f"mutant {number} of {name}: the reader ended with {worker.returncode}", flush=True)
    return number + 1


def work(numbers: Iterator[int]) -> None:
    """Read one mutant after the other and say of each what came of it."""
    faulthandler.enable()
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE_BYTES, _ADDRESS_SPACE_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("error")
    with TemporaryDirectory() as folder:
        corpus = list(forms(Path(folder)).values())
        for number in numbers:
            rng = random.Random(number)
            form = rng.choice(corpus)
            print("begins", number, form.name, flush=True)
            start_s, before_kib = time.perf_counter(), peak_kib()
            try:
                outcome = "refused" if read_mutant(form, mutant(form.content, rng), Path(folder)) else "read"
            except Exception:
                outcome = "FOUND " + " | ".join(traceback.format_exc().splitlines()[-7:])
            took_s, taken_kib = time.perf_counter() - start_s, peak_kib() - before_kib
            if took_s > SECONDS_MAX or taken_kib > MEMORY_MAX_KIB:
                outcome = f"FOUND {took_s:.1f} s, {taken_kib >> 10} MiB"
            print(outcome, flush=True)


def peak_kib() -> int:
    """Return the largest memory that this process has had, KiB."""
    found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    return int(found[1]) if found else 0


if __name__ == "__main__":
    main()
