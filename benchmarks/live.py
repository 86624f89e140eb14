"""Measure the live run: rates, latency by stage, drops and memory, with a recording saved and no export.

Each run is the installed command in a process of its own, replaying at the recorded rate. Memory is that of
the process and those it started, what they share counted once. `--lock` samples who holds the lock of the
segmenting process, five seconds after the start (needs py-spy, and takes a few percent of its time).

Examples
--------
The rendered scene, recorded first, then a folder that is replayed for ten minutes::

    python recordings/make_demo.py --scene frames=600 --out scene.mcap
    python benchmarks/live.py scene.mcap --lock -- --record copy-{date}.mcap
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
from collections import Counter
from datetime import datetime
from pathlib import Path
from typing import Any

import psutil

from nurbseg.common.computer import computer

COMMAND = Path(sys.executable).with_name("nurbseg-live")
#: Time between two looks at the memory, and before samples of the lock, seconds.
_MEMORY_EVERY_S, _SETTLED_S = 2.0, 5.0
STAGES = ("wait", "register", "segment", "identify", "capture_to_labels", "show")


def main() -> None:
    """Run and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", help="what nurbseg-live replays")
    parser.add_argument("--duration", type=float, default=20.0, help="seconds of each run (20)")
    parser.add_argument("--runs", type=int, default=5, help="runs of which medians are taken (5)")
    parser.add_argument("--lock", action="store_true", help="print who holds Python's lock")
    parser.add_argument("options", nargs="*", help="further options of nurbseg-live, after --")
    arguments = parser.parse_intermixed_args()
    source, duration_s, options = arguments.source, arguments.duration, arguments.options
    reports = [one_run(source, duration_s, options, lock=arguments.lock) for _ in range(arguments.runs)]
    print(f"{arguments.source}: {arguments.runs} runs of {arguments.duration:g} s at the recorded rate")
    print(computer(), *(f"{name} {version}" for name, version in reports[0]["versions"].items()), sep=", ")
    print(f"\n{'':20}{'median':>10}{'least':>10}{'most':>10}")
    frames = [report["frames"] for report in reports]
    overwritten = [each["dropped"]["overwritten_by_a_newer_frame"] for each in frames]
    rows = {
        "frames/s segmented": [report["frames_per_s"] for report in reports],
        "frames read": [each["read"] for each in frames],
        "dropped, %": [100.0 * n / max(1, each["read"]) for n, each in zip(overwritten, frames, strict=True)],
        "segmented anew": [sum(report["segmented_anew"].values()) for report in reports],
        "first labels, s": [report["first_labels_s"] for report in reports],
        "too late, %": [100.0 * each["late"] / max(1, each["read"]) for each in frames],
        "resident, MB": [report["resident_mb"] for report in reports],
        "recording, MB": [report["saved_mb"] for report in reports],
    }
    for name in reports[0]["lock"]:
        rows[f"lock: {name}, %"] = [report["lock"].get(name, 0.0) for report in reports]
    for name, values in rows.items():
        print(f"{name:20}{statistics.median(values):10.2f}{min(values):10.2f}{max(values):10.2f}")
    print(f"\n{'stage, ms':20}{'p50':>10}{'p95':>10}{'most':>10}")
    for stage in STAGES:
        found = [report["latency_ms"][stage] for report in reports if stage in report["latency_ms"]]
        if found:
            medians = (statistics.median(each[key] for each in found) for key in ("p50", "p95", "max"))
            print(f"{stage:20}" + "".join(f"{value:10.1f}" for value in medians))


def one_run(source: str, duration_s: float, options: list[str], *, lock: bool = False) -> dict[str, Any]:
    """Run the command; return its report with what was seen from outside."""
    with tempfile.TemporaryDirectory() as folder:
        saved, report = Path(folder) / "run.rrd", Path(folder) / "report.json"
        words = [str(COMMAND), "--replay", source, "--speed", "1", "--loop", "--duration", str(duration_s)]
        words += ["--view", "none", "--save", str(saved), "--report", str(report), *options]
        started_s, started_at = time.monotonic(), time.time()
        process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
        resident: list[float] = []
        if lock:
            time.sleep(_SETTLED_S)
            spy = f"py-spy record --gil -t -f raw -r 200 -p {process.pid} -o {folder}/lock"
            subprocess.run([*spy.split(), "-d", str(round(duration_s - 2 * _SETTLED_S))], check=True)
        while process.poll() is None:
            if time.monotonic() - started_s > 10.0 * duration_s + 60.0:
                process.kill()
                raise SystemExit(f"{source}: did not end in time")
            if megabytes := resident_mb(process):
                resident.append(megabytes)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_MEMORY_EVERY_S)
        if process.returncode:
            said = process.stderr and process.stderr.read()
            raise SystemExit(f"{source}: ended with {process.returncode}:\n{said}")
        found: dict[str, Any] = json.loads(report.read_text())
        # The report counts from the start of the run; Python and its packages start before that.
        ahead_s = datetime.fromisoformat(found["began"]).timestamp() - started_at
        return {
            **found,
            "resident_mb": max(resident, default=float("nan")),
            "lock": shares(Path(folder, "lock").read_text()) if lock else {},
            "saved_mb": saved.stat().st_size / 1e6,
            "first_labels_s": found["first_result_after_s"] + ahead_s,
        }


def shares(samples: str) -> dict[str, float]:
    """Return the percentage of samples, lines ``thread;function;... count``, by who held the lock."""
    counts: Counter[str] = Counter()
    for stack, _, count in (line.rpartition(" ") for line in samples.splitlines()):
        thread = stack.partition(";")[0].rpartition(": ")[2]
        segments = thread == "MainThread" and "process (nurbseg/library/segmenter.py" in stack
        counts["segmentation" if segments else "others"] += int(count)
        counts[thread] += 0 if segments else int(count)
    total = max(1, counts["segmentation"] + counts["others"])
    return {name: 100.0 * count / total for name, count in counts.most_common()}


def resident_mb(command: subprocess.Popen[str]) -> float:
    """Return what a command and the processes it started reside in, shared pages once; 0 where not known."""
    with contextlib.suppress(psutil.Error):
        process = psutil.Process(command.pid)
        family = process, *process.children(recursive=True)
        return float(sum(each.memory_full_info().pss for each in family)) / 1e6
    return 0.0


if __name__ == "__main__":
    main()
