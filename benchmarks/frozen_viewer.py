"""What a frozen viewer costs: the same run without a viewer and with one under SIGSTOP, both saved.

A viewer is started without a window, connected to, and stopped by a signal; then frames are segmented,
shown and saved, turn about with runs without any viewer. Prints the time of a frame in both, their
ratio, the longest `show`, the time to close, and whether any saved file lacks a frame.

Needs a Vulkan driver for the viewer (Debian: mesa-vulkan-drivers).
Usage: python benchmarks/frozen_viewer.py [--source recordings/demo.mcap] [--frames 40] [--rounds 3]
"""

from __future__ import annotations

import argparse
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from run_files import viewer_chunks

from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.isolated import IsolatedView
from nurbseg.app.view.opening import open_view
from nurbseg.app.view.viewer import free_port, listens, start_viewer
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.registry import open_source
from nurbseg.library.segmenter import process_frame
from nurbseg.segmentation.config import SegmentationConfig


@dataclass(frozen=True, slots=True)
class Run:
    """Times of one run: of a frame in all, the longest `show`, and closing; seconds."""

    frame_s: float
    longest_show_s: float
    close_s: float


def run(
    frames: list[RGBDFrame],
    config: SegmentationConfig,
    settings: ViewConfig,
    viewer: subprocess.Popen[bytes] | None,
) -> Run:
    """Segment, show and save the frames; the viewer, if any, is frozen before the first."""
    view = open_view(settings, config)
    longest_s = 0.0
    try:
        if viewer is not None:
            deadline_s = time.monotonic() + 30.0
            while not isinstance(view, IsolatedView) or not view.connections:
                if time.monotonic() > deadline_s:
                    raise SystemExit("the viewer was not connected to")
                time.sleep(0.05)
            viewer.send_signal(signal.SIGSTOP)
        began_s = time.perf_counter()
        for frame in frames:
            result = process_frame(frame, config)
            show_s = time.perf_counter()
            view.show(result)
            longest_s = max(longest_s, time.perf_counter() - show_s)
        frame_s = (time.perf_counter() - began_s) / len(frames)
    finally:
        began_s = time.perf_counter()
        view.close()
        close_s = time.perf_counter() - began_s
        if viewer is not None:
            viewer.send_signal(signal.SIGCONT)
    return Run(frame_s, longest_s, close_s)


def missing_frames(path: Path, frames: list[RGBDFrame]) -> set[int]:
    """Return the numbers of the frames that lack an image, the surfaces or the tree in a saved file."""
    found: dict[str, set[int]] = {"world/camera/image/depth": set(), "world/surfaces": set(), "tree": set()}
    for entity, records in viewer_chunks(path):
        if entity in found:
            found[entity].update(records.column("frame").to_pylist())
    return {frame.index for frame in frames} - set.intersection(*found.values())


def main() -> int:
    """Run the command; return 1 if a frame is missing or the slow-down is 10 % or more."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", default="recordings/demo.mcap", help="what to replay (%(default)s)")
    parser.add_argument("--frames", type=int, default=40, help="frames in a run (default: 40)")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each kind (default: 3)")
    options = parser.parse_args()
    config = SegmentationConfig()
    with open_source(options.source) as source:
        frames = list(islice(source, options.frames))
    process_frame(frames[0], config)

    # Ended by a signal, the run still ends its viewer.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    port = free_port("127.0.0.1")
    viewer = start_viewer(ViewConfig(), port, "--headless")
    runs: dict[str, list[Run]] = {"no viewer": [], "frozen viewer": []}
    missing: set[int] = set()
    try:
        deadline_s = time.monotonic() + 30.0
        while not listens("127.0.0.1", port):
            if viewer.poll() is not None or time.monotonic() > deadline_s:
                raise SystemExit("the viewer does not start; is a Vulkan driver installed?")
            time.sleep(0.1)
        with tempfile.TemporaryDirectory() as folder:
            for number in range(options.rounds):
                path = Path(folder) / f"{number}.rrd"
                none = ViewConfig(mode="none", save=str(path))
                runs["no viewer"].append(run(frames, config, none, None))
                missing |= missing_frames(path, frames)
                frozen = ViewConfig(mode="connect", connect=f"127.0.0.1:{port}", save=str(path))
                runs["frozen viewer"].append(run(frames, config, frozen, viewer))
                missing |= missing_frames(path, frames)
                path.unlink()
    finally:
        viewer.kill()
        viewer.wait()

    print(f"{'':14}{'frame, ms':>12}{'longest show, ms':>20}{'close, ms':>12}   ({len(frames)} frames a run)")
    medians = {}
    for kind, of_kind in runs.items():
        medians[kind] = statistics.median(each.frame_s for each in of_kind)
        longest = max(each.longest_show_s for each in of_kind)
        close = max(each.close_s for each in of_kind)
        print(f"{kind:14}{1e3 * medians[kind]:12.1f}{1e3 * longest:20.1f}{1e3 * close:12.0f}")
    slowdown = medians["frozen viewer"] / medians["no viewer"] - 1.0
    print(f"slow-down by the frozen viewer: {100 * slowdown:+.1f} %; frames missing in files: {len(missing)}")
    return 1 if missing or slowdown >= 0.1 else 0


if __name__ == "__main__":
    sys.exit(main())
