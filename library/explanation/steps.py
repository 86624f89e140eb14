"""The splits of a tree in the order of its growth, kept and rejected ones, and the merging of its leaves."""

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from nurbseg.library.contact_words import contact
from nurbseg.library.explanation import words
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.judged import JudgedSplit
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.vocabulary import Division

Kind = Literal["cut", "gap", "crease", "protrusion", "fold", "merge"]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A segment of a step, or a part of it.

    Parameters
    ----------
    name : str or None
        In the tree; None for a part of a rejected split, which is not in it.
    side : int
        Its side of the cut, 0 or 1.
    fit : Fit
        Its surface, if any, its points, residuals and metrics, on the grid on which splits are decided.
    value : float or None
        The deciding metric as it counts in the ratio: at least the noise floor. None without a surface.
    """

    name: str | None
    side: int
    fit: Fit
    value: float | None

    @property
    def points(self) -> int:
        """Number of points that the metric was measured on."""
        return int(self.fit.pixels.size)

    def summary(self, metric: Metric) -> str:
        """Return the metric with its unit, and the number of points."""
        if self.value is None:
            return f"{self.points:,} points, no surface"
        at_floor = self.fit.floor > 0 and self.value <= self.fit.floor
        value = words.value_text(metric, self.value)
        return f"{value} on {self.points:,} points{', the noise floor' if at_floor else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A decision of the segmentation.

    Parameters
    ----------
    number : int
        From 1 on.
    kind : {"cut", "gap", "crease", "protrusion", "fold", "merge"}
        A normalized cut; components that are not connected; planes that meet in a crease; parts in front of
        a surface; two leaves that one surface explains; leaves that became one object.
    name, depth : str, int
        Of the segment in the tree, or of the first leaf of an object.
    whole, parts : Part, tuple of Part
        The segment and its parts, or an object and its leaves.
    metric, ratio_max : str, float
        The deciding metric, and T.
    ratio : float or None
        Metric of the parts over that of the whole (eq. 5); None where the ratio does not decide.
    kept : bool
        Whether the parts are kept apart; False for leaves that became one object.
    sentence, evidence : str, tuple of str
        The decision and its reason; for an object the log odds of its pairs of leaves.
    """

    number: int
    kind: Kind
    name: str
    depth: int
    whole: Part
    parts: tuple[Part, ...]
    metric: Metric
    ratio: float | None
    ratio_max: float
    kept: bool
    sentence: str
    evidence: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """The ratio, T and what follows; empty where the ratio does not decide."""
        if self.ratio is None:
            return ""
        result = "kept apart" if self.kept else "one surface" if self.kind == "fold" else "not kept"
        return f"ratio {words.compared(self.ratio, self.ratio_max)}, T = {self.ratio_max:g}: {result}"


def steps_of(
    tree: SegmentationTree,
    judged: Iterable[JudgedSplit],
    config: SegmentationConfig,
    label_of_object: Mapping[int, int],
) -> tuple[Step, ...]:
    """Return the steps of a frame that was segmented by itself, of which an observer got `judged`.

    Growth first, the worst segment before others (section 3.3); then leaves that one surface explains,
    creases, protrusions, and objects of several leaves, under their labels. Splits that were undone later are
    not in the tree, and not here.
    """
    by_trial = {id(each.trial): each for each in judged}
    kinds = [(_kind(each, by_trial), each) for each in _in_order(tree, config.metric)]
    stages: tuple[tuple[Kind, ...], ...] = (("gap", "cut"), ("fold",), ("crease",), ("protrusion",))
    grown = [
        _step(tree, each, kind, by_trial, config) for stage in stages for kind, each in kinds if kind in stage
    ]
    steps = enumerate([*grown, *_merges(tree, config, label_of_object)], start=1)
    return tuple(replace(step, number=number) for number, step in steps)


def parts_of(tree: SegmentationTree, segment: Segment) -> list[tuple[Segment, int]]:
    """Return the parts of a segment and their sides: below nodes without a surface, which only chain them."""
    found, waiting = [], [(tree[name], side) for side, name in enumerate(segment.children)]
    while waiting:
        part, side = waiting.pop(0)
        if part.division is Division.GAP:
            waiting[:0] = [(tree[name], side) for name in part.children]
        else:
            found.append((part, side))
    return found


def _in_order(tree: SegmentationTree, metric: Metric) -> Iterator[Segment]:
    """Yield segments as the tree grew: of those that wait the one with the largest metric."""
    waiting: list[tuple[float, str]] = [(0.0, "")]
    while waiting:
        segment = tree[heapq.heappop(waiting)[1]]
        yield segment
        for part, _ in parts_of(tree, segment):
            heapq.heappush(waiting, (-part.fit.value(metric), part.name))


def _kind(segment: Segment, judged: Mapping[int, JudgedSplit]) -> Kind | None:
    """Return the kind of a segment's step; None if no split of it was judged."""
    if segment.division is not None:
        return cast(Kind, segment.division.value)  # nothing appears in a frame by itself
    return None if segment.trial is None else "fold" if judged[id(segment.trial)].folded else "cut"


def _step(
    tree: SegmentationTree,
    segment: Segment,
    kind: Kind,
    by_trial: Mapping[int, JudgedSplit],
    config: SegmentationConfig,
) -> Step:
    trial, metric = segment.trial, config.metric
    if segment.children:
        parts = [_part(part.name, side, part.fit, metric) for part, side in parts_of(tree, segment)]
    else:
        split = by_trial[id(trial)]
        parts = [_part(None, side, fit, metric) for side, fit in zip(split.sides, split.fits, strict=True)]
    whole = _part(segment.name, 0, segment.fit, metric)
    ratio = None if trial is None else trial.ratio
    kept = bool(segment.children)
    if kind == "crease" and trial is not None:
        # Its own values decided, without a floor.
        values = (trial.value, *(value for value, _ in trial.parts))
        whole, *parts = (
            replace(part, fit=replace(part.fit, floor=0.0), value=value)
            for part, value in zip((whole, *parts), values, strict=True)
        )
        sentence = words.creased(len(parts), trial.ratio)
    elif ratio is not None:
        sentence = words.judged(len(parts), metric, ratio, config.ratio_max, kept=kept, fold=kind == "fold")
    else:
        sentence = words.divided(kind, len(parts))
    named = (kind, segment.name, segment.depth)
    return Step(0, *named, whole, tuple(parts), metric, ratio, config.ratio_max, kept, sentence)


def _part(name: str | None, side: int, fit: Fit, metric: Metric) -> Part:
    return Part(name, side, fit, None if fit.surface is None else fit.value(metric))


def _merges(
    tree: SegmentationTree, config: SegmentationConfig, label_of_object: Mapping[int, int]
) -> Iterator[Step]:
    """Yield a step for each object of several leaves."""
    for number, thing in enumerate(tree.objects, start=1):
        if len(thing.leaves) == 1:
            continue
        leaves = [tree[name] for name in thing.leaves]
        pixels = np.concatenate([leaf.fit.pixels for leaf in leaves])
        own = [each for each in tree.contacts if {each.first, each.second} <= set(thing.leaves)]
        own.sort(key=lambda each: -each.log_odds)
        parts = tuple(_part(leaf.name, 0, leaf.fit, config.metric) for leaf in leaves)
        whole = Part(None, 0, Fit(None, np.zeros(0), {}, f"{len(leaves)} surfaces", pixels), None)
        sentence = words.merged(label_of_object.get(number), len(leaves), own[0])
        values = (config.metric, None, config.ratio_max, False, sentence, tuple(map(contact, own)))
        yield Step(0, "merge", leaves[0].name, leaves[0].depth, whole, parts, *values)


def children_in_steps(tree: SegmentationTree) -> dict[str, Sequence[str]]:
    """Return the names of the parts of each segment that is not a mere chain, leaves included."""
    found: dict[str, Sequence[str]] = {}
    waiting = [tree.root]
    while waiting:
        segment = waiting.pop()
        parts = [part for part, _ in parts_of(tree, segment)]
        found[segment.name] = [part.name for part in parts]
        waiting += parts
    return found
