"""Ctrl-C and SIGTERM at random moments of a run, from the first millisecond on.

Each run is the installed command on the demo recording, with everything written that it can write. It must
end within 2 s of the signal, without a traceback, and leave whole files::

    python benchmarks/signals.py --runs 500

A quarter of the signals comes within the first 0.1 s, half of them within the first second. A Ctrl-C while
Python itself starts, before the first line of this project, is Python's own; those are counted apart.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from run_files import contradictory_trees, viewer_chunks

from nurbseg.app.live.opening import demo_uri
from nurbseg.common.computer import computer
from nurbseg.common.errors import DriverError
from nurbseg.drivers.registry import open_source

COMMAND = Path(sys.executable).with_name("nurbseg-live")
LIMIT_S = 2.0
#: A run that has not ended by then hangs.
_HANG_S = 60.0
#: Ends of the ranges that moments are drawn from in turn, seconds after the start.
_MOMENTS_S = (0.1, 1.0, 3.0, 5.0)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a signal did: its moment, how long the end took, the exit code, whose it was, what is wrong."""

    number: int
    name: str
    moment_s: float
    took_s: float
    code: int
    pythons: bool
    wrong: tuple[str, ...]


def main() -> None:
    """Send signals and print what came of them; exits with 1 where a promise does not hold."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=500, help="how many (500)")
    parser.add_argument("--at-once", type=int, default=1, help="how many at the same time (1)")
    parser.add_argument("--first", type=int, default=0, help="number of the first run (0)")
    given = parser.parse_args()
    # Where this runs in the background, Ctrl-C is ignored, by whatever is started as well.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    outcomes = []
    with ThreadPoolExecutor(given.at_once) as pool:
        for outcome in pool.map(one_signal, range(given.first, given.first + given.runs)):
            outcomes.append(outcome)
            print(outcome, flush=True)
    sys.exit(print_table(outcomes))


def print_table(outcomes: list[Outcome]) -> bool:
    """Print the table; return whether anything is wrong."""
    print(f"\n{len(outcomes)} signals; {computer()}")
    print(f"{'moment':>12}{'signals':>9}{'median, s':>11}{'longest, s':>12}{'Python':>8}{'wrong':>7}  codes")
    begin_s = 0.0
    for end_s in _MOMENTS_S:
        found = [outcome for outcome in outcomes if begin_s <= outcome.moment_s < end_s]
        if found:
            took_s = np.array([each.took_s for each in found])
            codes = ", ".join(f"{code}: {n}" for code, n in sorted(Counter(e.code for e in found).items()))
            wrong = sum(bool(each.wrong) for each in found)
            print(
                f"{begin_s:5g} - {end_s:<3g}s{len(found):>9}{np.median(took_s):11.2f}{took_s.max():12.2f}"
                f"{sum(each.pythons for each in found):8}{wrong:7}  {codes}"
            )
        begin_s = end_s
    return any(outcome.wrong for outcome in outcomes)


def one_signal(number: int) -> Outcome:
    """Start the command, send it a signal, and look at what is there."""
    rng = random.Random(number)
    moment_s = rng.uniform(0.0, _MOMENTS_S[number % len(_MOMENTS_S)])
    which = rng.choice((signal.SIGINT, signal.SIGTERM))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = ["--replay", demo_uri(), "--loop", "--view", "none", "--record", "X.mcap", "--save", "X.rrd"]
        words += ["--export", "out", "--report", "report.json"]
        begun_s = time.monotonic()
        with (
            (folder / "said").open("wb") as said,
            subprocess.Popen([COMMAND, *words], cwd=folder, stderr=said) as process,
        ):
            time.sleep(max(0.0, begun_s + moment_s - time.monotonic()))
            sent_s = time.monotonic()
            process.send_signal(which)
            try:
                code = process.wait(_HANG_S)
            except subprocess.TimeoutExpired:
                process.kill()
                code = process.wait()
            took_s = time.monotonic() - sent_s
        text = (folder / "said").read_text()
        # Nothing of ours is being imported yet, let alone run, but what holds the way to it.
        modules = re.findall(r"/nurbseg/(\S+)\.py", text)
        pythons = "KeyboardInterrupt" in text and set(modules) <= {"app/__init__", "app/commands"}
        wrong = [] if pythons else wrong_with(folder)
    if took_s > LIMIT_S and not pythons:
        wrong.append(f"{took_s:.1f} s")
    if code not in (128 + which, -which) and not pythons:
        wrong.append(f"exit code {code}")
    return Outcome(number, which.name, round(moment_s, 4), took_s, code, pythons, tuple(wrong))


def wrong_with(folder: Path) -> list[str]:
    """Return what is wrong with what a run said and wrote."""
    wrong = []
    said = (folder / "said").read_text()
    if "Traceback" in said or "Fatal" in said:
        wrong.append(f"traceback: {' | '.join(said.splitlines()[-6:])}")
    if (folder / "report.json").exists():
        ended = json.loads((folder / "report.json").read_text())["ended"]
        if ended not in ("interrupted", "still running"):
            wrong.append(f"report.json: ended: {ended}")
    wrong += contradictory_trees(folder / "out")
    wrong += [f"{path.name} is left" for path in folder.rglob("*.part")]
    if (folder / "X.mcap").exists():
        try:
            with open_source(folder / "X.mcap") as source:
                whole = source.metadata["whole"]
                if whole != "true" or not len(list(source)):
                    wrong.append("X.mcap: has no end, or no frames")
        except DriverError as err:
            wrong.append(str(err))
    if (folder / "X.rrd").exists():
        try:
            list(viewer_chunks(folder / "X.rrd"))
        except Exception as err:
            wrong.append(f"X.rrd: {err}")
    return wrong


if __name__ == "__main__":
    main()
