"""Measure the live run: rates, latency by stage, drops and memory, with a recording saved and no export.

Each run is the installed command in a process of its own, replaying at the recorded rate. Memory is that of
the process and those it started, what they share counted once; its slope is fitted to the second half of the
run.

Examples
--------
The rendered scene, recorded first, then a folder that is replayed over and over for ten minutes::

    python recordings/make_demo.py --scene frames=600 --out scene.mcap
    python benchmarks/live.py scene.mcap
    python benchmarks/live.py FOLDER --duration 600 --runs 1 -- --intrinsics 585,585,320,240
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from nurbseg.common.computer import computer

COMMAND = Path(sys.executable).with_name("nurbseg-live")
#: Time between two looks at the memory, seconds.
_MEMORY_EVERY_S = 2.0
STAGES = ("wait", "register", "segment", "identify", "capture_to_labels", "show")


def main() -> None:
    """Run and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", help="what nurbseg-live replays")
    parser.add_argument("--duration", type=float, default=20.0, help="seconds of each run (20)")
    parser.add_argument("--runs", type=int, default=5, help="runs of which medians are taken (5)")
    parser.add_argument("options", nargs="*", help="further options of nurbseg-live, after --")
    arguments = parser.parse_intermixed_args()
    reports = [
        one_run(arguments.source, arguments.duration, arguments.options) for _ in range(arguments.runs)
    ]
    print(f"{arguments.source}: {arguments.runs} runs of {arguments.duration:g} s at the recorded rate")
    print(computer())
    versions = reports[0]["versions"]
    print(", ".join(f"{name} {version}" for name, version in versions.items()))
    print(f"\n{'':20}{'median':>10}{'least':>10}{'most':>10}")
    rows = {
        "frames/s segmented": [report["frames_per_s"] for report in reports],
        "frames read": [report["frames"]["read"] for report in reports],
        "dropped, %": [100.0 * dropped(report) / max(1, report["frames"]["read"]) for report in reports],
        "segmented anew": [sum(report["segmented_anew"].values()) for report in reports],
        "first labels, s": [report["first_labels_s"] for report in reports],
        "too late, %": [
            100.0 * report["frames"]["late"] / max(1, report["frames"]["read"]) for report in reports
        ],
        "resident, MB": [report["resident_mb"] for report in reports],
        "slope, MB/min": [report["slope_mb_per_min"] for report in reports],
        "recording, MB": [report["saved_mb"] for report in reports],
    }
    for name, values in rows.items():
        print(f"{name:20}{statistics.median(values):10.2f}{min(values):10.2f}{max(values):10.2f}")
    print(f"\n{'stage, ms':20}{'p50':>10}{'p95':>10}{'most':>10}")
    for stage in STAGES:
        found = [report["latency_ms"][stage] for report in reports if stage in report["latency_ms"]]
        if found:
            medians = (statistics.median(each[key] for each in found) for key in ("p50", "p95", "max"))
            print(f"{stage:20}" + "".join(f"{value:10.1f}" for value in medians))


def dropped(report: dict[str, Any]) -> int:
    """Return how many frames were overwritten by newer ones."""
    return int(report["frames"]["dropped"]["overwritten_by_a_newer_frame"])


def one_run(source: str, duration_s: float, options: list[str]) -> dict[str, Any]:
    """Run the command; return its report with what was seen from outside."""
    with tempfile.TemporaryDirectory() as folder:
        saved, report = Path(folder) / "run.rrd", Path(folder) / "report.json"
        words = [str(COMMAND), "--replay", source, "--speed", "1", "--loop", "--duration", str(duration_s)]
        words += ["--view", "none", "--save", str(saved), "--report", str(report), *options]
        started_s, started_at = time.monotonic(), time.time()
        process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
        times: list[float] = []
        resident: list[float] = []
        while process.poll() is None:
            if time.monotonic() - started_s > 10.0 * duration_s + 60.0:
                process.kill()
                raise SystemExit(f"{source}: did not end in time")
            megabytes = resident_mb(process)
            if megabytes:
                times.append(time.monotonic() - started_s)
                resident.append(megabytes)
            # Reading it takes ten milliseconds of a core, and holds up the processes meanwhile.
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_MEMORY_EVERY_S)
        said = "" if process.stderr is None else process.stderr.read()
        if process.returncode:
            raise SystemExit(f"{source}: ended with {process.returncode}:\n{said}")
        found: dict[str, Any] = json.loads(report.read_text())
        half = len(times) // 2
        slope = np.polyfit(times[half:], resident[half:], 1)[0] if len(times) - half > 2 else float("nan")
        # The report counts from the start of the run; Python and its packages start before that.
        ahead_s = datetime.fromisoformat(found["began"]).timestamp() - started_at
        return {
            **found,
            "resident_mb": max(resident, default=float("nan")),
            "slope_mb_per_min": 60.0 * float(slope),
            "saved_mb": saved.stat().st_size / 1e6,
            "first_labels_s": found["first_result_after_s"] + ahead_s,
        }


def resident_mb(command: subprocess.Popen[str]) -> float:
    """Return what a command and the processes it started reside in, shared pages once; 0 where not known."""
    total = 0.0
    try:
        process = psutil.Process(command.pid)
        for child in (process, *process.children(recursive=True)):
            total += child.memory_full_info().pss / 1e6
    except psutil.Error:
        return 0.0
    return total


if __name__ == "__main__":
    main()
