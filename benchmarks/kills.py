"""What `kill -9` takes of recordings that are made while frames are segmented, exported and saved.

A virtual camera, which is a real OpenNI2 driver, shows images that are known by their number. Each run is
the installed command with its processes, all of which are killed at a random moment. Then every frame of the
recording is compared with the camera's, and what the camera had delivered with what is in the file::

    python benchmarks/kills.py --runs 200

Half of the runs record color as JPEG, half as it is. Exits with 1 where a frame is wrong, a file cannot be
replayed, or more than 0.2 s are lost in more than 1 % of the runs. Where a computer does other things too,
frames wait to be written; `--slowdown 4` lets the camera's clock go at a quarter of its pace, by which times
count then.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
from run_files import contradictory_trees, viewer_chunks

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "virtualcam"))
# The camera that the tests have.
from virtual_camera import VirtualCameras, build, color_image, depth_image

from nurbseg.common.computer import computer
from nurbseg.common.errors import DriverError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.registry import open_source

COMMAND = Path(sys.executable).with_name("nurbseg-live")
LOST_S_MAX, SHARE = 0.2, 0.99
FPS = 30
#: The camera's pattern is like nothing that one sees, and would take seconds to segment.
_SEGMENTATION = ("--splits-max", "12", "--decimation", "8")
#: Recording begins and frames are segmented within this time, seconds.
_BEGIN_S = 90.0
#: Moments of the kill after that, seconds.
_MOMENTS_S = (0.3, 2.0)
#: Depth at the camera's first pixel: in its first image, how much more in each, and how many values; mm.
_FIRST_MM, _STEP_MM, _RANGE_MM = 500 + 3 * 5, 11, 4000


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one kill left: frames in the recording, wrong ones among them, time lost, what else is broken."""

    number: int
    suffix: str
    frames: int
    wrong: int
    lost_s: float
    saved: int
    broken: tuple[str, ...]


def main() -> None:
    """Kill and count; exits with 1 where a promise does not hold."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=200, help="how many (200)")
    parser.add_argument("--at-once", type=int, default=1, help="how many at the same time (1)")
    parser.add_argument(
        "--slowdown", type=int, default=1, help="clock of the camera, for a computer that does other things"
    )
    parser.add_argument("--first", type=int, default=0, help="number of the first run (0)")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.at_once) as pool:
        redist = build(Path(folder) / "redist")
        numbers = range(given.first, given.first + given.runs)
        outcomes = []
        for outcome in pool.map(
            lambda number: one_kill(number, given.slowdown, Path(folder), redist), numbers
        ):
            outcomes.append(outcome)
            print(outcome, flush=True)
    sys.exit(print_table(outcomes))


def print_table(outcomes: list[Outcome]) -> bool:
    """Print the table; return whether a promise does not hold."""
    print(f"\n{len(outcomes)} kills; {computer()}")
    columns = ("runs", "frames", "wrong", "median", "99 %", "worst", "over 0.2 s", "broken")
    print(f"{'':8}" + "".join(f"{column:>11}" for column in columns) + "   (lost, s)")
    for suffix in sorted({outcome.suffix for outcome in outcomes}):
        of_kind = [outcome for outcome in outcomes if outcome.suffix == suffix]
        lost_s = np.array([each.lost_s for each in of_kind])
        median, nearly_all = np.percentile(lost_s, [50, 100 * SHARE], method="higher")
        values = (
            f"{len(of_kind)}",
            f"{sum(each.frames for each in of_kind)}",
            f"{sum(each.wrong for each in of_kind)}",
            *(f"{value:.3f}" for value in (median, nearly_all, lost_s.max())),
            f"{(lost_s > LOST_S_MAX).sum()}",
            f"{sum(len(each.broken) for each in of_kind)}",
        )
        print(f"{suffix:8}" + "".join(f"{value:>11}" for value in values))
    lost_s = np.array([outcome.lost_s for outcome in outcomes])
    return bool(
        np.mean(lost_s <= LOST_S_MAX) < SHARE or any(outcome.wrong or outcome.broken for outcome in outcomes)
    )


def one_kill(number: int, slowdown: int, folder: Path, redist: Path) -> Outcome:
    """Start the command, kill it with all its processes, and look at what is there."""
    rng = random.Random(number)
    suffix, color = ((".mcap", "jpeg95"), (".mcap", "raw"))[number % 2]
    own = Path(tempfile.mkdtemp(dir=folder))
    (own / "cameras").mkdir()
    cameras = VirtualCameras(redist, own / "cameras")
    diary = own / "diary"
    cameras.add(diary=diary, slowdown=slowdown)
    recording = own / f"X{suffix}"
    words = ["--device", "any", "--view", "none", "--record", str(recording), "--record-color", color]
    words += ["--save", str(own / "X.rrd"), "--export", str(own / "out"), "--verbose", *_SEGMENTATION]
    environment = os.environ | cameras.environment
    with subprocess.Popen([COMMAND, *words], stderr=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stderr is not None
        deadline_s = time.monotonic() + _BEGIN_S
        for line in process.stderr:
            if "segments in" in line:
                break
            if time.monotonic() > deadline_s:
                process.kill()
        time.sleep(slowdown * rng.uniform(*_MOMENTS_S))
        family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
        killed_ns = time.monotonic_ns()
        for each in family:
            os.kill(each.pid, signal.SIGKILL)
        process.stderr.close()
    psutil.wait_procs(family, timeout=30)
    outcome = looked_at(number, own, recording, color, diary, killed_ns)
    if not outcome.wrong and not outcome.broken:
        for path in sorted(own.rglob("*"), reverse=True):
            path.unlink() if path.is_file() else path.rmdir()
    return outcome


def looked_at(number: int, own: Path, recording: Path, color: str, diary: Path, killed_ns: int) -> Outcome:
    """Hold what is there against what the camera delivered."""
    broken = []
    images = (line.split() for line in diary.read_text().splitlines())
    delivered = [int(image) for image, at_ns in images if int(at_ns) <= killed_ns]
    frames = wrong = 0
    last = -1
    try:
        with open_source(recording) as source:
            for frame in source:
                last = image_number(frame)
                wrong += not is_exact(frame, last, exact_color=color == "raw")
                frames += 1
    except DriverError as err:
        broken.append(str(err))
    saved = frames_saved(own / "X.rrd", broken)
    broken += contradictory_trees(own / "out")
    return Outcome(
        number, recording.suffix, frames, wrong, (delivered[-1] - last) / FPS, saved, tuple(broken)
    )


def image_number(frame: RGBDFrame) -> int:
    """Return which of the camera's images this is, by its first pixel."""
    grown = (int(frame.depth_mm[0, 0]) - _FIRST_MM) % _RANGE_MM
    return grown * pow(_STEP_MM, -1, _RANGE_MM) % _RANGE_MM


def is_exact(frame: RGBDFrame, number: int, *, exact_color: bool) -> bool:
    """Whether a frame is what the camera showed; JPEG may differ as JPEG does."""
    if not np.array_equal(frame.depth_mm, depth_image(number)):
        return False
    shown = color_image(number)
    return np.array_equal(frame.color, shown) if exact_color else frame.color.shape == shown.shape


def frames_saved(path: Path, broken: list[str]) -> int:
    """Return how many frames the viewer's file holds, and note where it cannot be read."""
    numbers: set[int] = set()
    try:
        for entity, records in viewer_chunks(path):
            if "depth" in entity:
                numbers.update(records.column("frame").to_pylist())
    except Exception as err:
        broken.append(f"{path.name}: {err}")
    return len(numbers)


if __name__ == "__main__":
    main()
