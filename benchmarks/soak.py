"""A long live run, and what becomes of its memory, threads, descriptors, latency and frames.

A virtual camera, which is a real OpenNI2 driver, shows frames of a recording over and over at 30 Hz. The
installed command records them in parts, segments them, and shows them in a viewer that is connected to. The
camera is unplugged every few minutes, and the viewer is ended and started again::

    python benchmarks/soak.py FOLDER --intrinsics 585,585,320,240 --minutes 120

The viewer is Rerun's server, which takes frames as a window does and needs no graphics. Memory is that of
each process alone (its proportional set size); the slope is fitted to the second half of its work.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from labelled import add_intrinsics

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "virtualcam"))
# The camera that the tests have.
from virtual_camera import VirtualCamera, VirtualCameras, build, dump_frames

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.viewer import free_port, start_web_server, viewer_executable
from nurbseg.common.computer import computer
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source

COMMAND = Path(sys.executable).with_name("nurbseg-live")
#: Time between two looks at the processes, seconds.
_POLL_S = 10.0
#: How long the camera and the viewer are away, seconds.
_AWAY_S = 3.0
#: Parts of the recording are deleted but for so many, to take no disk.
_PARTS_KEPT = 2
#: Modules by which the processes are distinguished.
_ROLES = {"process.program": "source", "view.program": "view", "nurbseg-live": "segmentation"}


@dataclass
class Life:
    """What was seen of one process: its role, and by time memory, threads and descriptors."""

    role: str
    minutes: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    threads: list[int] = field(default_factory=list)
    descriptors: list[int] = field(default_factory=list)

    def slope(self) -> float:
        """Return how memory grew in the second half of its work, 10^6 bytes a minute.

        A process that looks for a lost camera has a fraction of its memory until there is one to read.
        """
        ready = next(n for n, memory_mb in enumerate(self.memory_mb) if memory_mb > 0.5 * self.memory_mb[-1])
        half = (ready + len(self.minutes)) // 2
        return float(np.polyfit(self.minutes[half:], self.memory_mb[half:], 1)[0])


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", help="what the camera shows: anything that can be replayed, VGA")
    add_intrinsics(parser)
    parser.add_argument("--frames", type=int, default=40, help="frames shown, forth and back (40)")
    parser.add_argument("--minutes", type=float, default=120.0, help="how long (120)")
    parser.add_argument("--unplug", type=float, default=5.0, help="minutes between two unplugs (5)")
    parser.add_argument("--viewer", type=float, default=10.0, help="minutes between two viewers (10)")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shown = folder / "frames"
        with open_source(given.source, SourceOptions(intrinsics=given.intrinsics)) as source:
            frames = list(islice(source, given.frames))
        # Forth and back, so that the loop has no jump.
        dump_frames(Played([*frames, *frames[-2:0:-1]]), shown, 2 * len(frames) - 2)
        (folder / "cameras").mkdir()
        cameras = VirtualCameras(build(folder / "redist"), folder / "cameras")
        camera = cameras.add(frames=shown)
        lives, report = soak(given, folder, camera, cameras.environment)
    print_tables(given, lives, report)


class Played:
    """Hands out frames, as a source does."""

    def __init__(self, frames: list[Any]) -> None:
        self._frames = iter(frames)

    def read(self) -> Any:
        """Return the next one."""
        return next(self._frames)


def soak(
    given: argparse.Namespace, folder: Path, camera: VirtualCamera, environment: dict[str, str]
) -> tuple[dict[int, Life], dict[str, Any]]:
    """Run, disturb and look; return what was seen of each process, and the run's own report."""
    port, web_port = free_port("127.0.0.1"), free_port("127.0.0.1")
    report, recording = folder / "report.json", folder / "X.mcap"
    words = ["--device", "any", "--duration", str(60 * given.minutes), "--report", str(report)]
    words += ["--connect", f"127.0.0.1:{port}", "--record", str(recording), "--record-split", "60"]
    lives: dict[int, Life] = {}
    viewer = start_web_server(ViewConfig(memory_limit="500MB"), port, web_port)
    unplug_s, viewer_s = 60 * given.unplug, 60 * given.viewer
    with (
        (folder.parent / "nurbseg-soak.log").open("w") as said,
        subprocess.Popen([COMMAND, *words], stderr=said, env=os.environ | environment) as process,
    ):
        began_s = time.monotonic()
        next_unplug_s, next_viewer_s = began_s + unplug_s, began_s + viewer_s
        while process.poll() is None:
            now_s = time.monotonic()
            if now_s >= next_unplug_s:
                camera.unplug()
                time.sleep(_AWAY_S)
                camera.plug()
                next_unplug_s += unplug_s
            if now_s >= next_viewer_s:
                viewer.kill()
                viewer.wait()
                time.sleep(_AWAY_S)
                viewer = start_web_server(ViewConfig(memory_limit="500MB"), port, web_port)
                next_viewer_s += viewer_s
            look(process.pid, (now_s - began_s) / 60, lives)
            parts = sorted(folder.glob("X*.mcap"), key=lambda part: part.stat().st_mtime)
            for part in parts[:-_PARTS_KEPT]:
                part.unlink()
            try:
                process.wait(_POLL_S)
            except subprocess.TimeoutExpired:
                continue
    viewer.kill()
    viewer.wait()
    return lives, json.loads(report.read_text()) | {"code": process.returncode}


def look(pid: int, minutes: float, lives: dict[int, Life]) -> None:
    """Note the figures of a process and of all that it started."""
    try:
        process = psutil.Process(pid)
        family = [process, *process.children(recursive=True)]
    except psutil.NoSuchProcess:
        return
    for each in family:
        try:
            words = " ".join(each.cmdline())
            role = next((role for word, role in _ROLES.items() if word in words), words[-40:])
            memory = each.memory_full_info().pss
            threads, descriptors = each.num_threads(), each.num_fds()
        except psutil.Error:
            continue
        life = lives.setdefault(each.pid, Life(role))
        life.minutes.append(minutes)
        life.memory_mb.append(memory / 1e6)
        life.threads.append(threads)
        life.descriptors.append(descriptors)


def print_tables(given: argparse.Namespace, lives: dict[int, Life], report: dict[str, Any]) -> None:
    """Print the tables."""
    print(f"{given.minutes:g} minutes of {given.source}; {computer()}, {os.cpu_count()} cores")
    rerun = subprocess.run([viewer_executable(), "--version"], capture_output=True, text=True, timeout=60)
    print(rerun.stdout.splitlines()[0])
    columns = ("minutes", "MB at first", "at last", "MB/min", "threads", "descriptors")
    print(f"\n{'process':14}" + "".join(f"{column:>13}" for column in columns))
    for life in sorted(lives.values(), key=lambda life: (life.role, life.minutes[0])):
        if len(life.minutes) < 6:
            continue
        # What starts takes its first threads and files; from the third look on they should be the same.
        threads, descriptors = sorted(set(life.threads[2:])), sorted(set(life.descriptors[2:]))
        print(
            f"{life.role:14}{life.minutes[-1] - life.minutes[0]:13.1f}{life.memory_mb[2]:13.1f}"
            f"{life.memory_mb[-1]:13.1f}{life.slope():13.2f}"
            f"{f'{threads[0]}-{threads[-1]}':>13}{f'{descriptors[0]}-{descriptors[-1]}':>13}"
        )
    print(f"\nexit code {report['code']}, ended: {report['ended']}, {report['frames_per_s']} frames/s")
    print(json.dumps(report["frames"]))
    print(json.dumps({key: report["recording"][key] for key in ("frames", "lost", "failure")}))
    print(json.dumps({stage: report["latency_ms"][stage] for stage in ("capture_to_labels", "segment")}))


if __name__ == "__main__":
    main()
