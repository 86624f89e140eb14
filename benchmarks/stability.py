"""Measure how live labels hold: against known motion, against frames segmented alone, and over time.

For every two successive frames, the pixels of the first are carried into the second by the known motion of
the camera and of the objects; on those that both frames see, labels are compared. Frames segmented alone have
no labels in common: they are matched so that as many pixels as possible agree.

Examples
--------
The rendered scene with a ball that is hidden for ten frames, then a folder with camera poses (``*.pose.txt``,
world from camera, beside the images)::

    python benchmarks/stability.py "scene:hide=10&frames=120"
    python benchmarks/stability.py FOLDER --frames 120
"""

from __future__ import annotations

import argparse
import statistics
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from rendered import SyntheticOptions, SyntheticSource
from scipy.optimize import linear_sum_assignment

from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.options import SourceOptions
from nurbseg.drivers.registry import open_source
from nurbseg.drivers.source import FrameSource
from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation.config import Level, SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree

#: Depth at which a carried pixel is seen again agrees within this share.
_DEPTH_SHARE = 0.02
#: A ground-truth object counts in frames where it has this many pixels with depth.
_OBJECT_PIXELS_MIN = 400

#: Gives the transforms from the camera of one frame to that of another: one for all, or one for each label.
Motion = Callable[[int, int], dict[int, NDArray[np.float64]]]
Labels = NDArray[np.uint16]


@dataclass
class Findings:
    """What was found for one level of labels."""

    live: list[float] = field(default_factory=list)
    alone: list[float] = field(default_factory=list)
    live_to_alone: list[float] = field(default_factory=list)
    alone_to_alone: list[float] = field(default_factory=list)
    alone_to_before: list[float] = field(default_factory=list)
    live_to_truth: list[float] = field(default_factory=list)
    alone_to_truth: list[float] = field(default_factory=list)


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("source", help="what nurbseg-live replays, with known motion")
    parser.add_argument("--frames", type=int, default=120, help="frames from the first on (120)")
    parser.add_argument("--every", type=int, default=4, help="segment every so many frames alone as well (4)")
    parser.add_argument("--seed", type=int, default=0, help="of the live tree (0)")
    arguments = parser.parse_args()
    config = SegmentationConfig(method="nurbseg", seed=arguments.seed)
    with opened(arguments.source) as source:
        motion = known_motion(source, arguments.source)
        measure(source, motion, config, arguments.frames, arguments.every)


def opened(uri: str) -> FrameSource:
    """Open a folder of frames, or the rendered scene with options after ``scene:``."""
    scheme, separator, options = uri.partition(":")
    if separator and scheme == "scene":
        return SyntheticSource(SyntheticOptions.from_text(options))
    return open_source(uri, SourceOptions())


def known_motion(source: FrameSource, uri: str) -> Motion:
    """Return the motion between any two frames of a source."""
    if isinstance(source, SyntheticSource):

        def of_scene(first: int, second: int) -> dict[int, NDArray[np.float64]]:
            (depth_before, before), (depth_after, after) = source.poses(first), source.poses(second)
            camera = np.linalg.inv(depth_after)
            moves = {0: camera @ depth_before}
            for label, pose in before.items():
                moves[label] = camera @ after[label] @ np.linalg.inv(pose) @ depth_before
            return moves

        return of_scene
    poses = [np.loadtxt(path) for path in sorted(Path(uri).glob("*.pose.txt"))]
    if not poses:
        raise SystemExit(f"{uri}: no *.pose.txt beside the images")
    return lambda first, second: {0: np.linalg.inv(poses[second]) @ poses[first]}


def carried_pixels(
    frame: RGBDFrame, cloud: PointMap, after: PointMap, moves: dict[int, NDArray[np.float64]]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return flat pixels of a frame and, for each, that of the next frame which sees the same point."""
    camera = frame.calibration.depth
    pixels = np.flatnonzero(cloud.valid)
    points = cloud.points_m.reshape(-1, 3)[pixels].astype(np.float64)
    owner = np.zeros(pixels.size, dtype=np.int64) if frame.labels is None else frame.labels.ravel()[pixels]
    moved = points @ moves[0][:3, :3].T + moves[0][:3, 3]
    for label, move in moves.items():
        own = owner == label
        if label and own.any():
            moved[own] = points[own] @ move[:3, :3].T + move[:3, 3]
    z = np.maximum(moved[:, 2], 1e-6)
    u = np.rint(camera.fx * moved[:, 0] / z + camera.cx).astype(np.intp)
    v = np.rint(camera.fy * moved[:, 1] / z + camera.cy).astype(np.intp)
    height, width = cloud.valid.shape
    seen = (moved[:, 2] > 0.1) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    pixels, target, depth = pixels[seen], v[seen] * width + u[seen], moved[seen, 2]
    there = after.points_m.reshape(-1, 3)[target, 2]
    same = np.abs(there - depth) < _DEPTH_SHARE * depth
    return pixels[same], target[same]


def agreement(before: Labels, after: Labels, pairs: tuple[NDArray[np.intp], NDArray[np.intp]]) -> float:
    """Return the share of carried pixels that keep their label."""
    return float(np.mean(before.ravel()[pairs[0]] == after.ravel()[pairs[1]]))


def best_agreement(before: Labels, after: Labels, pairs: tuple[NDArray[np.intp], NDArray[np.intp]]) -> float:
    """Return the share of carried pixels that agree when labels are matched as well as possible."""
    a, b = before.ravel()[pairs[0]].astype(np.int64), after.ravel()[pairs[1]].astype(np.int64)
    size = int(b.max()) + 1
    table = np.bincount(a * size + b, minlength=(int(a.max()) + 1) * size).reshape(-1, size)
    rows, columns = linear_sum_assignment(-table)
    return float(table[rows, columns].sum() / a.size)


def bits_between(labels: Labels, others: Labels) -> float:
    """Return the variation of information of two label maps, bits."""
    return Contingency.between(labels, others).variation_of_information()


def levels(tree: SegmentationTree) -> dict[str, Labels]:
    """Return both label images of a tree."""
    return {level: tree.labels(level) for level in get_args(Level)}


def measure(source: FrameSource, motion: Motion, config: SegmentationConfig, count: int, every: int) -> None:
    """Run the live mode over a source and print what is found."""
    segmenter = Segmenter(config, temporal=True)
    found: dict[str, Findings] = defaultdict(Findings)
    named: dict[int, Counter[int]] = defaultdict(Counter)
    cold: Counter[str] = Counter()
    events: Counter[str] = Counter()
    before: tuple[RGBDFrame, PointMap, dict[str, Labels]] | None = None
    for place, frame in enumerate(islice(source, count)):
        result = segmenter.process(frame)
        cloud = result.cloud
        if result.update is not None and result.update.reset:
            cold[result.update.reset] += 1
        events.update(event.kind for event in result.events)
        live = {level: result.labels(level) for level in get_args(Level)}
        if before is not None:
            pairs = carried_pixels(before[0], before[1], cloud, motion(place - 1, place))
            for level, labels in live.items():
                found[level].live.append(agreement(before[2][level], labels, pairs))
            if place % every == 0:
                # Independent: the samples of each frame are drawn by a seed of its own.
                alone = levels(segment(cloud, replace(config, seed=place)))
                other = levels(segment(cloud, replace(config, seed=place + 100_000)))
                earlier = levels(segment(before[1], replace(config, seed=place - 1)))
                for level in live:
                    each = found[level]
                    each.alone.append(best_agreement(earlier[level], alone[level], pairs))
                    each.live_to_alone.append(bits_between(live[level], alone[level]))
                    each.alone_to_alone.append(bits_between(other[level], alone[level]))
                    carried = earlier[level].ravel()[pairs[0]], alone[level].ravel()[pairs[1]]
                    each.alone_to_before.append(bits_between(*carried))
                    if frame.labels is not None:
                        truth = np.where(cloud.valid, frame.labels, 0)
                        each.live_to_truth.append(bits_between(live[level], truth))
                        each.alone_to_truth.append(bits_between(alone[level], truth))
        if frame.labels is not None:
            truth = np.where(cloud.valid, frame.labels, 0)
            for label in np.flatnonzero(np.bincount(truth.ravel()) >= _OBJECT_PIXELS_MIN):
                own = live["objects"][truth == label]
                if label:
                    named[int(label)][int(np.bincount(own).argmax())] += 1
        before = frame, cloud, live
    report(found, named, cold, events, source)


def report(
    found: dict[str, Findings],
    named: dict[int, Counter[int]],
    cold: Counter[str],
    events: Counter[str],
    source: FrameSource,
) -> None:
    """Print the findings."""
    print("level     labels carried by known motion     VoI to the frame alone, bits")
    print("          live mean (least)   alone, matched   live     two seeds   frame before alone")
    for level, each in found.items():
        print(
            f"{level:9} {100 * statistics.mean(each.live):6.2f} % ({100 * min(each.live):5.1f})"
            f"   {100 * statistics.mean(each.alone):8.2f} %"
            f"     {statistics.mean(each.live_to_alone):6.3f}   {statistics.mean(each.alone_to_alone):6.3f}"
            f"      {statistics.mean(each.alone_to_before):6.3f}"
        )
    for level, each in found.items():
        if each.live_to_truth:
            live, alone = (statistics.mean(values) for values in (each.live_to_truth, each.alone_to_truth))
            print(f"{level:9} VoI to the ground truth, bits: live {live:.3f}, alone {alone:.3f}")
    print(f"segmented anew: {dict(cold)}; events: {dict(sorted(events.items()))}")
    names = source.label_names if isinstance(source, SyntheticSource) else {}
    for label, counts in sorted(named.items()):
        (most, times), total = counts.most_common(1)[0], sum(counts.values())
        print(
            f"{names.get(label, str(label)):20} {100 * times / total:5.1f} % of {total} frames as {most}"
            f" ({len(counts)} labels)"
        )


if __name__ == "__main__":
    main()
