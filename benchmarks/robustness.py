"""How far the scores move: over seeds, and on frames mirrored, noisier, with holes or half as large.

Examples
--------
Labeled frames without calibration, as the tables of docs/accuracy.md::

    python benchmarks/robustness.py FOLDER FOLDER --intrinsics 525,525,319.5,239.5
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from ablation import SCORES, measured, registered
from labelled import frames_parser, labelled_frames

from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.segmentation.config import SegmentationConfig

#: Standard deviation of the noise that is added to inverse depth, 1/m.
_NOISE_PER_M = 1.25e-3
#: Share of the pixels that lose their depth, in discs of these radii, pixels.
_HOLES_SHARE, _HOLES_PX = 0.05, (1, 2, 3, 4)


def mirrored(frame: RGBDFrame, rng: np.random.Generator) -> RGBDFrame:
    """Swap left and right."""
    return _sampled(frame, slice(None, None, -1), 1)


def noisier(frame: RGBDFrame, rng: np.random.Generator) -> RGBDFrame:
    """Add noise of one size in inverse depth."""
    noise_per_m = _NOISE_PER_M * rng.standard_normal(frame.depth_mm.shape)
    depth_mm = frame.depth_mm / (1.0 + 1e-3 * frame.depth_mm * noise_per_m)
    return replace(frame, depth_mm=np.rint(np.clip(depth_mm, 0, 65_535)).astype(np.uint16))


def with_holes(frame: RGBDFrame, rng: np.random.Generator) -> RGBDFrame:
    """Take depth out in discs."""
    height, width = frame.depth_mm.shape
    holes = np.zeros((height, width), dtype=np.uint8)
    while holes.mean() < _HOLES_SHARE:
        center = int(rng.integers(width)), int(rng.integers(height))
        cv2.circle(holes, center, int(rng.choice(_HOLES_PX)), 1, cv2.FILLED)
    return replace(frame, depth_mm=np.where(holes > 0, 0, frame.depth_mm).astype(np.uint16))


def halved(frame: RGBDFrame, rng: np.random.Generator) -> RGBDFrame:
    """Take every second row and column."""
    return _sampled(frame, slice(None, None, 2), 2)


def _sampled(frame: RGBDFrame, columns: slice, step: int) -> RGBDFrame:
    """Take some columns and every `step`-th row of a registered frame, with the camera that sees these."""
    camera, window = frame.calibration.depth, (slice(None, None, step), columns)
    depth_mm, color = (np.ascontiguousarray(each[window]) for each in (frame.depth_mm, frame.color))
    first, _, across = columns.indices(camera.width)
    seen = replace(
        camera,
        width=depth_mm.shape[1],
        height=depth_mm.shape[0],
        fx=camera.fx / step,
        fy=camera.fy / step,
        cx=(camera.cx - first) / across,
        cy=camera.cy / step,
    )
    labels = None if frame.labels is None else np.ascontiguousarray(frame.labels[window])
    return replace(
        frame, depth_mm=depth_mm, color=color, labels=labels, calibration=Calibration.registered(seen)
    )


VARIATIONS: dict[str, Callable[[RGBDFrame, np.random.Generator], RGBDFrame]] = {
    "as they are": lambda frame, rng: frame,
    "mirrored": mirrored,
    f"noise of {_NOISE_PER_M} 1/m added": noisier,
    f"{_HOLES_SHARE:.0%} of the depth taken out in holes": with_holes,
    "every second row and column": halved,
}


def rows(frames: list[RGBDFrame], seeds: int) -> list[str]:
    """Measure every variation over seeds, the variation's own randomness among them; the lines of a table."""
    names = [name for name, _ in SCORES]
    lines = ["| frames | " + " | ".join(names) + " | seeds, GTRC | GTRC moves by |", "|---" * 7 + "|"]
    usual = np.nan
    for name, vary in VARIATIONS.items():
        means = []
        for seed in range(seeds):
            varied = [vary(frame, np.random.default_rng([seed, n])) for n, frame in enumerate(frames)]
            values = measured(registered(varied), replace(SegmentationConfig(), seed=seed))
            means.append(values[:, : len(SCORES)].mean(axis=0))
        average, spread = np.mean(means, axis=0), np.std(means, axis=0)
        covering = names.index("GTRC")
        usual = average[covering] if np.isnan(usual) else usual
        cells = [f"{each:.4f}" for each in average]
        cells += [f"{spread[covering]:.4f}", f"{average[covering] - usual:+.4f}"]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        print(lines[-1], file=sys.stderr, flush=True)
    return lines


def main() -> int:
    """Run from the command line."""
    given = frames_parser(__doc__, "labeled frames whose depth is registered").parse_args()
    for path in given.frames:
        frames = labelled_frames(path, given)
        if not all(frame.calibration.is_registered for frame in frames):
            print(f"{path}: expected depth registered to color", file=sys.stderr)
            return 2
        print("\n".join([f"{Path(path).name}, {len(frames)} frames:", "", *rows(frames, given.seeds), ""]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
