"""Time the segmentation by stage, size and splits, beside scikit-image's felzenszwalb on the same frames.

Examples
--------
The demo recording, then frames without calibration, with the literal version of the method as well::

    python benchmarks/segmentation.py
    python benchmarks/segmentation.py FOLDER --intrinsics 525,525,319.5,239.5 --frames 9 --literal
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import scipy
import skimage
from labelled import add_intrinsics, frames_of
from registration import milliseconds
from skimage.segmentation import felzenszwalb

from nurbseg.common.computer import computer
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.segmentation import stag15
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended import frame as nurbseg_frame
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap, Registration, register
from nurbseg.segmentation.surfaces.fit import fit_surface

DEMO = Path(__file__).parent.parent / "recordings" / "demo.mcap"
#: For each method the module that grows the tree, and the stage that the time of its functions belongs to.
STAGES: dict[str, tuple[ModuleType, dict[str, str]]] = {
    "stag15": (
        stag15,
        {
            "decimated_grid": "grid",
            "raw_vectors": "vectors",
            "normalization": "vectors",
            "normalized": "vectors",
            "normalized_cut": "cut",
            "_cleaned": "clean-up",
            "fit_on_grid": "fit",
            "all_metrics": "curvature",
            "upsample_labels": "every pixel",
        },
    ),
    "nurbseg": (
        nurbseg_frame,
        {
            "grid_features": "prepare",
            "ungrown_tree": "fit",
            "split_segment": "split",
            "fold_leaves": "fold",
            "split_at_creases": "creases",
            "split_off_protrusions": "protrusions",
            "refit_surfaces": "borders",
            "upsample_by_depth": "borders",
            "refine_borders": "borders",
            "merge_surfaces": "merge",
        },
    ),
}
SIZES = {"QVGA": (320, 240), "VGA": (640, 480), "SXGA": (1280, 960)}


@contextmanager
def stage_clock(module: ModuleType, stages: dict[str, str]) -> Iterator[dict[str, float]]:
    """Measure the time spent in each stage while the tree is made, in ms."""
    spent: dict[str, float] = defaultdict(float)
    originals = {name: getattr(module, name) for name in stages}

    def timed(name: str) -> Callable[..., Any]:
        def clocked(work: Callable[[], Any]) -> Any:
            start = time.perf_counter()
            try:
                return work()
            finally:
                spent[stages[name]] += 1e3 * (time.perf_counter() - start)

        def call(*arguments: Any, **options: Any) -> Any:
            found = clocked(lambda: originals[name](*arguments, **options))
            return steps(found) if isinstance(found, Iterator) else found

        def steps(found: Iterator[Any]) -> Iterator[Any]:
            # A generator works when it is asked for its next value.
            end = object()
            while (value := clocked(lambda: next(found, end))) is not end:
                yield value

        return call

    for name in originals:
        setattr(module, name, timed(name))
    try:
        yield spent
    finally:
        for name, original in originals.items():
            setattr(module, name, original)


def resized(frame: RGBDFrame, width: int, height: int) -> RGBDFrame:
    """Return a registered frame at another size, depth by nearest neighbor."""
    camera = frame.calibration.depth.scaled_to(width, height)
    return replace(
        frame,
        depth_mm=cv2.resize(frame.depth_mm, (width, height), interpolation=cv2.INTER_NEAREST),
        color=cv2.resize(frame.color, (width, height), interpolation=cv2.INTER_LINEAR),
        calibration=Calibration.registered(camera),
        labels=None,
    )


def full_frame_fit(config: SegmentationConfig, repeat: int) -> float:
    """Time one fit to every pixel of a VGA frame, residuals included."""
    rows, columns = np.mgrid[:480, :640].astype(np.float32)
    depth = 1.5 + 0.001 * rows + 0.2 * np.sin(columns / 50)
    points = np.stack([(columns - 319.5) / 525 * depth, (rows - 239.5) / 525 * depth, depth], axis=-1)
    cloud = PointMap(points, np.zeros((480, 640, 3), dtype=np.uint8), np.ones((480, 640), dtype=bool))
    pixels = np.arange(480 * 640)
    return milliseconds(lambda: fit_surface(cloud, pixels, config), repeat)


def by_size(frames: list[RGBDFrame], config: SegmentationConfig, repeat: int) -> None:
    """Print how the time grows with the number of pixels."""
    if not frames:
        return
    print("\nsize    pixels     tree   per megapixel")
    sums = []
    for name, (width, height) in SIZES.items():
        clouds = [register(resized(frame, width, height)) for frame in frames]
        total = statistics.mean(
            milliseconds(lambda cloud=cloud: segment(cloud, config), repeat) for cloud in clouds
        )
        sums.append((width * height, total))
        print(f"{name:6} {width * height:8} {total:8.1f} {1e6 * total / (width * height):10.1f}")
    exponent = np.polyfit(*np.log(np.array(sums)).T, 1)[0]
    print(f"time grows with pixels to the power of {exponent:.2f}")


def by_splits(frame: RGBDFrame, config: SegmentationConfig, repeat: int) -> None:
    """Print how the time grows with the number of splits, for as many as the frame has."""
    print("\nsplits allowed   made     tree   per split")
    cloud = register(frame)
    found: list[tuple[int, float]] = []
    for allowed in (2, 4, 8, 16, 32, 64):
        limited = replace(config, splits_max=allowed)
        splits = sum(each.cut is not None for each in segment(cloud, limited).segments)
        if splits == 0 or (found and splits == found[-1][0]):
            break
        total = milliseconds(lambda limited=limited: segment(cloud, limited), repeat)
        found.append((splits, total))
        print(f"{allowed:14} {splits:6} {total:8.1f} {total / splits:11.2f}")
    if len(found) > 1:
        exponent = np.polyfit(*np.log(np.array(found)).T, 1)[0]
        print(f"time grows with splits to the power of {exponent:.2f}")


def main() -> None:
    """Run and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", nargs="?", default=str(DEMO), help="what nurbseg-live replays (the demo)")
    add_intrinsics(parser)
    parser.add_argument("--frames", type=int, default=5, help="frames, spread over the data (5)")
    parser.add_argument("--repeat", type=int, default=5, help="runs of which the median is taken (5)")
    parser.add_argument("--method", default="nurbseg", choices=STAGES, help="segmentation method (nurbseg)")
    parser.add_argument("--literal", action="store_true", help="time the literal version too: minutes")
    arguments = parser.parse_args()
    frames = frames_of(arguments.data, arguments)
    frames = frames[:: max(1, len(frames) // arguments.frames)][: arguments.frames]
    config = SegmentationConfig(method=arguments.method)
    versions = f"numpy {np.__version__}, scipy {scipy.__version__}, OpenCV {cv2.__version__}"
    print(computer())
    print(f"Python {platform.python_version()}, {versions}, scikit-image {skimage.__version__}")
    print(f"{len(frames)} frames of {arguments.data}, medians of {arguments.repeat} runs, ms\n")

    module, stages = STAGES[config.method]
    columns = list(dict.fromkeys(stages.values()))
    print(
        "frame".ljust(12),
        "register",
        "  tree",
        *(column.rjust(9) for column in columns),
        " segments    fh04  ratio",
    )
    rows = []
    for frame in frames:
        cloud = register(frame)
        registration = Registration()
        registered = milliseconds(lambda frame=frame, r=registration: r.register(frame), arguments.repeat)
        whole = milliseconds(lambda cloud=cloud: segment(cloud, config), arguments.repeat)
        spends = []
        for _ in range(arguments.repeat):
            with stage_clock(module, stages) as spent:
                found = segment(cloud, config)
            spends.append(spent)
        by_stage = [statistics.median(spent[column] for spent in spends) for column in columns]
        peer = milliseconds(
            lambda frame=frame: felzenszwalb(frame.color, scale=1000, sigma=0.8, min_size=750),
            arguments.repeat,
        )
        rows.append((registered, whole, *by_stage, peer, whole / peer))
        name = frame.name or str(frame.index)
        print(f"{name:12} {registered:8.1f} {whole:6.1f}", *(f"{each:9.1f}" for each in by_stage), end=" ")
        print(f"{len(found.leaves()):9} {peer:7.1f} {whole / peer:6.3f}")
    medians = [statistics.median(column) for column in zip(*rows, strict=True)]
    print("median".ljust(12), f"{medians[0]:8.1f} {medians[1]:6.1f}", end=" ")
    print(*(f"{median:9.1f}" for median in medians[2:-2]), " " * 9, f"{medians[-2]:7.1f} {medians[-1]:6.3f}")
    print(f"\nfull VGA frame, 20x20 control points, residuals: {full_frame_fit(config, 15):.1f} ms")

    by_size([frame for frame in frames if frame.calibration.is_registered][:3], config, arguments.repeat)
    by_splits(max(zip(frames, rows, strict=True), key=lambda each: each[1][1])[0], config, arguments.repeat)

    if arguments.literal:
        import literal

        cloud = register(frames[0])
        start = time.perf_counter()
        literal.segment(cloud, config)
        spent_literally = 1e3 * (time.perf_counter() - start)
        print(
            f"\nliteral version, first frame: {spent_literally:.0f} ms, {spent_literally / rows[0][1]:.0f} x"
        )


if __name__ == "__main__":
    main()
