"""Run all that measures speed, in less than 15 minutes, and write one JSON; or compare two of these.

Everything is measured once in each round, and rounds go on while there is time for another, so that what the
computer does besides falls on all alike. What runs in this process counts time on the processor; a command
counts that of all its processes, and how long it took.

Examples
--------
The demo recording alone, then one more folder, then what became slower from one to the other::

    python benchmarks/all.py --out before.json
    python benchmarks/all.py FOLDER --out after.json
    python benchmarks/all.py --compare before.json after.json
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import live
import numpy as np
import registration
from rendered import SyntheticSource, recorded
from skimage.segmentation import felzenszwalb

import segmentation  # noqa: TID251
from nurbseg.common.computer import computer, versions
from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import Registration, register

#: Slower by more than this share is reported; with such a confidence it counts.
SLOWER, CONFIDENCE = 0.05, 0.95
_DRAWS = 4000
_FRAMES = 3
_WORKERS = (1, 2, 4)

#: Values by what was measured; the unit ends the name, and less is better in all of them.
Measured = dict[str, float]


def processor_ms(work: Callable[[], object]) -> float:
    """Return the time on the processor that some work takes in this process."""
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def cases(sources: list[str]) -> Iterator[Callable[[], Measured]]:
    """Yield what is measured once a round; each has done it once before, uncounted."""
    for name, options in registration.CASES.items():
        with SyntheticSource(options) as source:
            frame = source.read()
        yield partial(in_process, f"register {name}, ms", partial(Registration().register, frame), 20)
    yield lambda: {"fit 20x20 to VGA, ms": segmentation.full_frame_fit(SegmentationConfig(), 5)}
    for uri in sources:
        with open_source(uri) as source:
            frames = list(source)
        for frame in frames[:: max(1, len(frames) // _FRAMES)][:_FRAMES]:
            cloud, name = register(frame), f"{Path(uri).name} {frame.name or frame.index}"
            for method in ("nurbseg", "stag15"):
                config = SegmentationConfig(method=method)  # type: ignore[arg-type]
                yield partial(in_process, f"{method} {name}, ms", partial(segment, cloud, config), 3)
            peer = partial(felzenszwalb, frame.color, scale=1000, sigma=0.8, min_size=750)
            yield partial(in_process, f"felzenszwalb {name}, ms", peer, 1)
        yield partial(start_of_command, uri)
        for count in _WORKERS:
            yield partial(batch, uri, count)
    with tempfile.TemporaryDirectory() as folder:
        yield partial(live_run, str(recorded("frames=300", Path(folder))))


def in_process(name: str, work: Callable[[], object], times: int) -> Measured:
    """Measure a call, the mean of some."""
    work()
    return {name: processor_ms(lambda: [work() for _ in range(times)]) / times}


def command(*words: str) -> Measured:
    """Run a command; return how long it took and what all its processes needed, in seconds."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    path = Path(sys.executable).with_name(words[0])
    done = subprocess.run([path, *words[1:]], capture_output=True, text=True, timeout=300)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)}: ended with {done.returncode}:\n{done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"took": time.monotonic() - start, "processor": spent}


def start_of_command(uri: str) -> Measured:
    """Measure the help, and the way to the first frame and out again."""
    helped = command("nurbseg-live", "--help")
    shown = command("nurbseg-live", "--replay", uri, "--speed", "0", "--frames", "1", "--view", "none")
    name = f"first frame of {Path(uri).name}"
    return {
        "--help, processor s": helped["processor"],
        f"{name}, s": shown["took"],
        f"{name}, processor s": shown["processor"],
    }


def batch(uri: str, workers: int) -> Measured:
    """Measure all frames of a recording by some processes."""
    with tempfile.TemporaryDirectory() as folder:
        found = command("nurbseg-batch", uri, "--export", folder, "--workers", str(workers))
        frames = json.loads((Path(folder) / "report.json").read_text())["segmented"]
        name = f"batch of {Path(uri).name} by {workers}"
        return {
            f"{name}, ms a frame": 1e3 * found["took"] / frames,
            f"{name}, processor ms a frame": 1e3 * found["processor"] / frames,
        }


def live_run(uri: str) -> Measured:
    """Measure a live run at the recorded rate, saved but not exported."""
    report = live.one_run(uri, 10.0, [])
    latency_ms = report["latency_ms"]["capture_to_labels"]
    return {
        "live, capture to labels p50, ms": latency_ms["p50"],
        "live, capture to labels p95, ms": latency_ms["p95"],
        "live, ms a frame segmented": 1e3 / max(report["frames_per_s"], 1e-9),
        "live, first labels, s": report["first_labels_s"],
    }


def measure(sources: list[str], limit_s: float) -> dict[str, Any]:
    """Measure in rounds while there is time for another; return the document."""
    cv2.setNumThreads(1)
    began_s, began_load = time.monotonic(), os.getloadavg()[0]
    values: dict[str, list[float]] = {}
    work, rounds, longest_s = list(cases(sources)), 0, 0.0
    while rounds < 1 or time.monotonic() - began_s + longest_s < limit_s:
        start_s = time.monotonic()
        for case in work:
            for name, value in case().items():
                values.setdefault(name, []).append(round(value, 4))
        rounds, longest_s = rounds + 1, max(longest_s, time.monotonic() - start_s)
        print(f"round {rounds}: {time.monotonic() - start_s:.0f} s", file=sys.stderr, flush=True)
    machine = {"computer": computer(), "cores": os.cpu_count(), "load": [began_load, os.getloadavg()[0]]}
    return {"machine": machine | {"versions": versions()}, "rounds": rounds, "values": values}


def slower(before: list[float], after: list[float], seed: int = 0) -> tuple[float, float]:
    """Return the ratio of medians, and the bootstrap's confidence that it is over 1 + `SLOWER`."""
    rng = np.random.default_rng(seed)
    old, new = (np.median(rng.choice(values, (_DRAWS, len(values))), axis=1) for values in (before, after))
    ratio = float(np.median(after) / np.median(before))
    return ratio, float((new > (1 + SLOWER) * old).mean())


def compare(before: dict[str, Any], after: dict[str, Any]) -> int:
    """Print what became slower, the surest first; return how many certainly did."""
    if before["machine"]["computer"] != after["machine"]["computer"]:
        print(f"two computers: {before['machine']['computer']}; {after['machine']['computer']}")
    common = [name for name in before["values"] if name in after["values"]]
    for name in sorted({*before["values"], *after["values"]} - set(common)):
        print(f"only in one of them: {name}")
    found = [(name, *slower(before["values"][name], after["values"][name])) for name in common]
    slowed = sorted((each for each in found if each[1] > 1 + SLOWER), key=lambda each: -each[2])
    for name, ratio, confidence in slowed:
        print(f"{name}: {100 * (ratio - 1):+.0f} %; confidence {confidence:.0%}")
    certain = sum(confidence >= CONFIDENCE for _, _, confidence in slowed)
    print(f"{certain} of {len(common)} slower by more than {100 * SLOWER:g} % with {CONFIDENCE:.0%} or more")
    return certain


def main() -> int:
    """Measure, or compare; return 1 where something became slower."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", nargs="*", help="recordings besides the demo, with their calibration")
    parser.add_argument("--out", type=Path, default=Path("benchmarks.json"), help="(%(default)s)")
    parser.add_argument("--minutes", type=float, default=12.0, help="time for all rounds (%(default)s)")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("BEFORE", "AFTER"), help="two results")
    given = parser.parse_args()
    if given.compare:
        before, after = (json.loads(path.read_text()) for path in given.compare)
        return 1 if compare(before, after) else 0
    document = measure([str(segmentation.DEMO), *given.data], 60 * given.minutes)
    given.out.write_text(json.dumps(document, indent=1) + "\n")
    print(f"{document['machine']['computer']}; {document['rounds']} rounds: {given.out}")
    for name, values in document["values"].items():
        print(f"{name:60}{np.median(values):12.3f}{min(values):12.3f}{max(values):12.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
