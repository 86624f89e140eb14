"""The model by which surfaces are merged: trained, and judged on frames it was not trained on.

Examples
--------
Labeled frames without calibration, as in docs/merging-model.md; needs scikit-learn::

    python benchmarks/merging.py FOLDER FOLDER --intrinsics 525,525,319.5,239.5 --save merging_model.npy
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from labelled import frames_parser, labelled_frames, numbers
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier
from smooth import smooth_surfaces

from nurbseg.common.frame import RGBDFrame
from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.evaluation.truth import Truth, ground_truth
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.frame import grow_tree, shown_leaves, ungrown_tree
from nurbseg.segmentation.extended.grid_features import grid_features
from nurbseg.segmentation.objects import agglomeration
from nurbseg.segmentation.objects.agglomeration import Pairs, agglomerate
from nurbseg.segmentation.objects.border_statistics import SAMPLES, add_border
from nurbseg.segmentation.objects.merge import Measured, measure
from nurbseg.segmentation.objects.pair_features import (
    FEATURES,
    GROUPS,
    NODE,
    MergingModel,
    merging_model,
    model_of,
    pair_features,
)
from nurbseg.segmentation.points.grid import grid_step
from nurbseg.segmentation.points.registration import register
from nurbseg.segmentation.segments import leaves_below

#: Trees, their leaves, the share of each that counts, least rows of a leaf, and the penalty on its value.
_BOOSTING = {
    "max_iter": 300,
    "max_leaf_nodes": 24,
    "learning_rate": 0.05,
    "min_samples_leaf": 60,
    "l2_regularization": 10.0,
}
#: Values that a feature can have in training.
_VALUES = 120
#: Orders in which the true merges of a frame are replayed for training.
_ORDERS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """The surfaces of a frame, the pixels each has in common with each region of the truth, and a weight."""

    frame: int
    measured: Measured
    common: NDArray[np.int64]
    weight: float = 1.0

    @property
    def region(self) -> NDArray[np.intp]:
        """Of each surface, where most of it is."""
        return self.common.argmax(axis=1)


#: Rows of training: features, whether most of both is of one region, and how much that counts.
Rows = tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.float64]]


def surfaces_of(
    number: int, frame: RGBDFrame, config: SegmentationConfig, truth: Truth, weight: float = 1.0
) -> Surfaces:
    """Segment a frame into surfaces, and measure each pair that meets."""
    assert frame.labels is not None
    cloud, regions = register(frame), ground_truth(frame.labels, truth)
    config = replace(config, decimation=grid_step(cloud.valid, config.decimation))
    features = grid_features(cloud, config)
    root = ungrown_tree(features, config)
    grow_tree(root, features, config, lambda: False)
    shown = shown_leaves(root, cloud, features, config)
    count = len(leaves_below(root))
    _, numbers = np.unique(np.append(0, regions), return_inverse=True)
    common = np.zeros((count + 1, int(numbers.max()) + 1), dtype=np.int64)
    np.add.at(common, (shown.labels.ravel(), numbers[1:]), 1)
    common[:, 0] = common[0] = 0
    measured = measure(shown.labels, features.grid, count, shown.surfaces, config)
    return Surfaces(number, measured, common, weight)


class Replay:
    """Merges the surfaces of a frame one by one, and computes the features of every pair that changes."""

    def __init__(self, frame: Surfaces) -> None:
        borders, surfaces, self._scene, _ = frame.measured
        self._surfaces, self._common, self._weight = surfaces.copy(), frame.common.copy(), frame.weight
        self.borders = {
            tuple(pair): own.copy() for pair, own in zip(borders.labels.tolist(), borders.sums, strict=True)
        }
        self._lengths = np.zeros(len(surfaces))
        for pair, own in self.borders.items():
            self._lengths[list(pair)] += own[SAMPLES]

    def row(self, pair: tuple[int, int]) -> tuple[NDArray[np.float64], bool, float]:
        """Return the features of a pair, whether it is one object, and how much that counts."""
        found, (one, other) = np.empty(FEATURES), pair
        pair_features(
            found,
            self.borders[pair],
            (self._surfaces[one], self._surfaces[other]),
            (self._lengths[one], self._lengths[other]),
            self._scene,
        )
        first, second = self._common[one], self._common[other]
        pixels = min(first.sum(), second.sum())
        if pixels == 0:
            return found, False, 0.0
        # A mistake costs the pixels of the smaller one; what is half of this and half of that says little.
        pure = min(first.max() / first.sum(), second.max() / second.sum())
        return (
            found,
            bool(first.argmax() == second.argmax()),
            float(self._weight * np.sqrt(pixels) * np.clip(2 * pure - 1, 0.05, 1)),
        )

    def merge(self, pair: tuple[int, int]) -> list[tuple[int, int]]:
        """Merge a pair, and return the pairs that have changed."""
        one, gone = pair
        self._lengths[one] += self._lengths[gone] - 2 * self.borders.pop(pair)[SAMPLES]
        self._surfaces[one] += self._surfaces[gone]
        self._common[one] += self._common[gone]
        for each in [border for border in self.borders if gone in border]:
            own = self.borders.pop(each)
            other = sum(each) - gone
            changed = (min(one, other), max(one, other))
            sums = self.borders.setdefault(changed, np.zeros_like(own))
            add_border(sums, own, (gone < other) != (one < other))
        return [border for border in self.borders if one in border]


def rows_of(frame: Surfaces, merges: Iterator[tuple[int, int]] | None, rng: np.random.Generator) -> Rows:
    """Return a row for each pair, and for each that merges change: those given, or true ones at random."""
    replay, region = Replay(frame), frame.region
    rows = [replay.row(pair) for pair in replay.borders]
    while True:
        if merges is None:
            true = [border for border in replay.borders if region[border[0]] == region[border[1]]]
            chosen = true[rng.integers(len(true))] if true else None
        else:
            chosen = next(merges, None)
        if chosen is None:
            break
        rows += [replay.row(pair) for pair in replay.merge(chosen)]
    features, same, certainty = zip(*rows, strict=True) if rows else ([], [], [])
    return np.reshape(features, (-1, FEATURES)), np.array(same, dtype=bool), np.array(certainty)


def merged(frame: Surfaces, model: MergingModel) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the group of each surface, and the merges in order."""
    borders, surfaces, scene, _ = frame.measured
    terms = agglomeration.evidence(borders.labels, borders.sums, surfaces, scene, model)
    odds, nothing = terms.sum(axis=1), np.zeros(len(terms))
    pairs = Pairs(borders.labels, borders.sums, odds, nothing)
    group, decided, done, *_ = agglomerate(pairs, surfaces, scene, model, 0.0)
    return group, decided[done]


def merged_by_truth(frame: Surfaces) -> NDArray[np.int64]:
    """Return the group of each surface if all pairs of one region are merged, as far as they meet."""
    group = np.arange(len(frame.common))
    for one, other in frame.measured.borders.labels:
        if frame.region[one] == frame.region[other]:
            ends = group[[one, other]]
            group[np.isin(group, ends)] = ends.min()
    return group


def trained(parts: Sequence[Rows], without: Sequence[str] = ()) -> NDArray[np.void]:
    """Boost trees on rows of training, without some groups of features, and return their nodes."""
    features, same, certainty = (np.concatenate(each) for each in zip(*parts, strict=True))
    kept = certainty > 0
    features, same, certainty = features[kept], same[kept], certainty[kept]
    left_out = [name in without for name, names in GROUPS.items() for _ in names]
    features[:, left_out] = 0.0
    for column in features.T:
        values = np.unique(np.quantile(column, np.linspace(0, 1, _VALUES), method="nearest"))
        column[:] = values[np.searchsorted((values[1:] + values[:-1]) / 2, column)]
    model = HistGradientBoostingClassifier(**_BOOSTING, early_stopping=False, random_state=0)
    model.fit(features, same, sample_weight=certainty / certainty.mean())
    base = np.zeros(1, dtype=NODE)
    base["low"], base["high"], base["value"] = -1, -1, np.ravel(model._baseline_prediction)[0]
    trees = [base]
    for (tree,) in model._predictors:
        nodes, first = np.zeros(len(tree.nodes), dtype=NODE), sum(map(len, trees))
        own, leaf = tree.nodes, tree.nodes["is_leaf"].astype(bool)
        nodes["feature"], nodes["threshold"] = own["feature_idx"], own["num_threshold"]
        for side, name in (("left", "low"), ("right", "high")):
            nodes[name] = np.where(leaf, -1, first + own[side].astype(np.int64))
        # Nodes come before those below them. Inner ones have the mean of their leaves.
        values, counts = own["value"].copy(), own["count"].astype(float)
        for n in reversed(range(len(own))):
            if not leaf[n]:
                below = [int(own["left"][n]), int(own["right"][n])]
                values[n] = np.average(values[below], weights=counts[below])
        nodes["value"] = values
        trees.append(nodes)
    return np.concatenate(trees)


def training(frames: Sequence[Surfaces], without: Sequence[str] = ()) -> NDArray[np.void]:
    """Train on true merges, and once more with those that the first model makes, mistakes included."""
    known = [
        rows_of(frame, None, np.random.default_rng(order)) for frame in frames for order in range(_ORDERS)
    ]
    first = model_of(trained(known, without))
    made = [(map(tuple, merged(frame, first)[1].tolist()), frame) for frame in frames]
    again = [rows_of(each, merges, np.random.default_rng(0)) for merges, each in made]
    return trained([*known, *again], without)


def scores(frame: Surfaces, group: NDArray[np.int64]) -> list[float]:
    """Score groups of surfaces: RI, GTRC, VoI, obj, and the two parts of VoI."""
    pixels = np.zeros_like(frame.common)
    np.add.at(pixels, group, frame.common)
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
        "--truth", choices=("labels", "joined"), default="joined", help="regions (%(default)s)"
    )
    parser.add_argument(
        "--folds", type=int, default=4, help="of the cross-validation; 0 for none (%(default)s)"
    )
    parser.add_argument("--weights", type=numbers, help="in training, of each of the folders (1 each)")
    parser.add_argument(
        "--smooth", type=int, default=0, help="number of frames that one smooth surface fills (%(default)s)"
    )
    parser.add_argument("--ablation", action="store_true", help="also without each group of features")
    parser.add_argument("--save", type=Path, help="write the model of all frames")
    given = parser.parse_args()
    weights = given.weights or (1.0,) * len(given.frames)
    frames = [
        (Path(path).name, weight, frame)
        for path, weight in zip(given.frames, weights, strict=True)
        for frame in labelled_frames(path, given)
    ]
    frames += [("smooth", 1.0, frame) for frame in smooth_surfaces(given.smooth)]
    groups = [name for name, _, _ in frames]
    known = [
        surfaces_of(number, frame, replace(SegmentationConfig(), seed=seed), given.truth, weight)
        for number, (_, weight, frame) in enumerate(frames)
        for seed in range(given.seeds)
    ]
    if len(groups) < 2:
        print("expected at least two frames with labels", file=sys.stderr)
        return 2
    if given.save is not None:
        np.save(given.save, training(known))
    for line in report(known, groups, given.folds, given.ablation):
        print(line, flush=True)
    return 0


def report(known: Sequence[Surfaces], groups: Sequence[str], folds: int, ablation: bool) -> Iterator[str]:
    """Lay out the scores by group of frames: as published, cross-validated, and merged by the truth."""
    yield from ("| frames | merged by | RI | GTRC | VoI | obj | under | over |", "|---" * 8 + "|")
    published = merging_model()
    yield from _table(known, groups, "nothing", [np.arange(len(each.common)) for each in known])
    yield from _table(known, groups, "published model", [merged(each, published)[0] for each in known])
    yield from _table(known, groups, "ground truth", [merged_by_truth(each) for each in known])
    fold_of = np.random.default_rng(5).permutation(len(groups)) % max(folds, 1)
    for without in ((), *((name,) for name in GROUPS if ablation)):
        found: list[NDArray[np.int64]] = [np.zeros(0, dtype=np.int64)] * len(known)
        for fold in range(folds):
            model = model_of(training([each for each in known if fold_of[each.frame] != fold], without))
            for n, each in enumerate(known):
                if fold_of[each.frame] == fold:
                    found[n] = merged(each, model)[0]
        if folds:
            name = "model of other frames" + "".join(f", without {each}" for each in without)
            yield from _table(known, groups, name, found)


def _table(
    known: Sequence[Surfaces], groups: Sequence[str], name: str, found: Sequence[NDArray[np.int64]]
) -> Iterator[str]:
    for group in dict.fromkeys(groups):
        own = [
            scores(each, merged)
            for each, merged in zip(known, found, strict=True)
            if groups[each.frame] == group
        ]
        yield f"| {group} | {name} | " + " | ".join(f"{mean:.4f}" for mean in np.mean(own, axis=0)) + " |"


if __name__ == "__main__":
    sys.exit(main())
