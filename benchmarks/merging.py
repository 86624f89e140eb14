"""The evidence by which surfaces are merged: trained, and judged on frames it was not trained on.

Examples
--------
Labeled frames without calibration, as in docs/accuracy.md; needs scikit-learn::

    python benchmarks/merging.py FOLDER FOLDER --intrinsics 525,525,319.5,239.5 --complex-from 55
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from labelled import frames_parser, labelled_frames
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression

from nurbseg.common.frame import RGBDFrame
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.refitting import refit_surfaces
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.objects.border_statistics import border_statistics
from nurbseg.segmentation.objects.evidence import BASE, DIGITS, GAP, TERMS, pair_features
from nurbseg.segmentation.objects.merge import agglomerate
from nurbseg.segmentation.objects.surface_statistics import surface_statistics
from nurbseg.segmentation.points.grid import depth_grid, grid_step
from nurbseg.segmentation.points.registration import register
from nurbseg.segmentation.scoring.scores import Contingency
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

#: Strength of the data against the penalty on the weights of standardised features.
_STRENGTH = 0.3
#: Log odds that no gap outweighs.
_CERTAIN = 1e3
Weights = tuple[float, NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """The surfaces of a frame, what is known of each pair that meets, and the ground truth.

    `common` has the pixels that each label has in common with each region, `same` whether most of both
    surfaces are of one region, `certainty` how much that counts.
    """

    frame: int
    pairs: NDArray[np.int64]
    samples: NDArray[np.int64]
    in_contact: NDArray[np.bool_]
    features: NDArray[np.float64]
    common: NDArray[np.int64]
    same: NDArray[np.bool_]
    certainty: NDArray[np.float64]


def surfaces_of(number: int, frame: RGBDFrame, config: SegmentationConfig) -> Surfaces:
    """Segment a frame into surfaces, and measure each pair that meets."""
    cloud, truth = register(frame), frame.labels
    assert truth is not None
    tree = segment(cloud, config)
    labels = tree.labels("surfaces").astype(np.int32)
    leaves = tree.leaves()
    grid, extended = depth_grid(cloud, grid_step(cloud.valid, config.decimation)), config.extended
    on_grid = np.zeros(grid.valid.shape, dtype=np.int32)
    for label, leaf in enumerate(leaves, start=1):
        rows, columns = np.divmod(leaf.fit.pixels, labels.shape[1])
        on_grid[rows // grid.step, columns // grid.step] = label
    _, surfaces, _ = refit_surfaces(on_grid, [leaf.fit for leaf in leaves], grid, config)
    borders = border_statistics(
        labels, SurfaceTable(surfaces).slopes, grid.rays, gap_per_m=extended.inverse_depth_gap
    )
    measured = surface_statistics(labels[:: grid.step, :: grid.step], len(leaves), grid)
    common = np.zeros((len(leaves) + 1, int(truth.max()) + 1), dtype=np.int64)
    np.add.at(common, (labels.ravel(), truth.ravel()), 1)
    common[:, 0] = common[0] = 0
    region, pixels = common.argmax(axis=1), common.sum(axis=1)
    purity = common.max(axis=1) / np.maximum(pixels, 1)
    first, second = borders.labels.T
    pure = np.minimum(purity[first], purity[second])
    # A mistake costs the pixels of the smaller surface; what is half of this and half of that says little.
    smaller = np.minimum(measured.pixels[first], measured.pixels[second])
    certainty = np.sqrt(smaller) * np.clip(2.0 * pure - 1.0, 0.05, 1.0)
    certainty[(pixels[first] == 0) | (pixels[second] == 0)] = 0.0
    return Surfaces(
        frame=number,
        pairs=borders.labels,
        samples=borders.samples.astype(np.int64),
        in_contact=borders.in_contact,
        features=pair_features(borders, measured, extended.inverse_depth_noise),
        common=common,
        same=region[first] == region[second],
        certainty=certainty,
    )


def trained(known: Sequence[Surfaces]) -> Weights:
    """Train the logistic regression: base, weights and neutral values."""
    features, same, certainty = (
        np.concatenate([getattr(each, name)[each.in_contact] for each in known])
        for name in ("features", "same", "certainty")
    )
    certainty /= certainty.mean()
    neutral = np.average(features, axis=0, weights=certainty)
    spread = np.sqrt(np.average(np.square(features - neutral), axis=0, weights=certainty))
    model = LogisticRegression(C=_STRENGTH, max_iter=1000)
    model.fit((features - neutral) / spread, same, sample_weight=certainty)
    return float(model.intercept_[0]), model.coef_[0] / spread, neutral


def log_odds(each: Surfaces, weights: Weights) -> NDArray[np.float64]:
    """Return those of every pair being one object."""
    base, slopes, neutral = weights
    return np.where(each.in_contact, base + (each.features - neutral) @ slopes, GAP)


def true_log_odds(each: Surfaces) -> NDArray[np.float64]:
    """Return what evidence without a mistake would give: it says nothing where surfaces do not touch."""
    return np.where(each.in_contact, np.where(each.same, _CERTAIN, -_CERTAIN), GAP)


def scores(each: Surfaces, odds: NDArray[np.float64], log_odds_min: float = 0.0) -> list[float]:
    """Merge surfaces and score the objects: RI, GTRC, VoI, obj, and the two parts of VoI."""
    count = len(each.common) - 1
    group = agglomerate(
        each.pairs.tolist(),
        np.round(odds, DIGITS).tolist(),
        each.samples.tolist(),
        count,
        log_odds_min,
    )
    pixels = np.zeros_like(each.common)
    np.add.at(pixels, group, each.common)
    table = Contingency(pixels[pixels.any(axis=1)][:, pixels.any(axis=0)])
    return [
        table.rand_index(),
        table.region_covering(),
        table.variation_of_information(),
        table.object_iou(),
        table.under_segmentation_bits(),
        table.over_segmentation_bits(),
    ]


def main() -> int:
    """Run from the command line."""
    parser = frames_parser(__doc__, "labeled frames: folders of pairs or recordings")
    parser.add_argument(
        "--complex-from", type=int, help="frames from this number on are a group of their own"
    )
    given = parser.parse_args()
    groups: list[str] = []
    known: list[Surfaces] = []
    for path in given.frames:
        for frame in labelled_frames(path, given):
            digits = re.search(r"\d+", frame.name)
            late = given.complex_from is not None and digits and int(digits[0]) >= given.complex_from
            groups.append(Path(path).name + (f" from {given.complex_from}" if late else ""))
            for seed in range(given.seeds):
                config = replace(SegmentationConfig(), seed=seed)
                known.append(surfaces_of(len(groups) - 1, frame, config))
    if len(groups) < 2:
        print("expected at least two frames with labels", file=sys.stderr)
        return 2
    print("\n".join(report(known, groups)))
    return 0


def report(known: Sequence[Surfaces], groups: Sequence[str]) -> list[str]:
    """Lay out the scores by group, as published and cross-validated, and the weights of all frames."""
    published = BASE, np.array([term.weight for term in TERMS]), np.array([term.neutral for term in TERMS])
    without = [trained([each for each in known if each.frame != frame]) for frame in range(len(groups))]
    rows = {
        "surfaces, nothing merged": [scores(each, np.full(len(each.pairs), -1.0)) for each in known],
        "published weights": [scores(each, log_odds(each, published)) for each in known],
        "weights of the other frames": [scores(each, log_odds(each, without[each.frame])) for each in known],
        "ground truth where they touch": [scores(each, true_log_odds(each)) for each in known],
        "merged by the ground truth": [scores(each, np.where(each.same, 1.0, -1e6)) for each in known],
    }
    lines = ["| frames | merged by | RI | GTRC | VoI | obj | under | over |", "|---" * 8 + "|"]
    for group in dict.fromkeys(groups):
        own = [n for n, each in enumerate(known) if groups[each.frame] == group]
        for name, values in rows.items():
            means = np.mean([values[n] for n in own], axis=0)
            lines.append(f"| {group} | {name} | " + " | ".join(f"{mean:.4f}" for mean in means) + " |")
    base, slopes, neutral = trained(known)
    spread = np.std([each[1] for each in without], axis=0) * np.sqrt(len(without))
    lines += [
        "",
        f"BASE = {base:.2f}",
        "",
        "| feature | weight | jackknife deviation | neutral |",
        "|---" * 4 + "|",
    ]
    for term, *values in zip(TERMS, slopes, spread, neutral, strict=True):
        lines.append(f"| {term.name} | " + " | ".join(f"{value:.3f}" for value in values) + " |")
    return lines


if __name__ == "__main__":
    sys.exit(main())
