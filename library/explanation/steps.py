"""The splits of a tree in the order of its growth, kept and rejected ones, and the merging of its leaves."""

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from nurbseg.library.explanation import words
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.judged import JudgedSplit
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.vocabulary import Division

Kind = Literal["cut", "gap", "crease", "protrusion", "fold", "merge"]
#: Kinds of the divisions of a frame by itself, in which nothing appears.
_KINDS: Mapping[Division, Kind] = {
    Division.CUT: "cut",
    Division.GAP: "gap",
    Division.CREASE: "crease",
    Division.PROTRUSION: "protrusion",
}


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A segment of a step, or a part of it.

    Parameters
    ----------
    name : str or None
        In the tree; None for a part of a split that was rejected, which is not in it.
    side : int
        The side of the cut that it is on, 0 or 1.
    fit : Fit
        Its surface, if it has one, and its points, residuals and metrics, on the grid on which splits are
        decided.
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

    def told(self, metric: Metric) -> str:
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
        A normalized cut; the components of what is not connected; planes that meet in a crease; parts in
        front of a surface; two leaves that meet smoothly, compared with one surface for both; leaves that
        became one object.
    name, parent, depth : str, str or None, int
        Of the segment in the tree, as those of `Segment`; of the first leaf of an object.
    whole : Part
        The segment.
    parts : tuple of Part
        Its parts, or the leaves of an object.
    metric : str
        The deciding one.
    ratio : float or None
        Metric of the parts over that of the whole (eq. 5); None where the ratio does not decide.
    ratio_max : float
        T, below which the ratio keeps a split.
    kept : bool
        Whether the parts are kept apart; for leaves that became one object it is False.
    sentence : str
        What was decided, and why.
    evidence : tuple of str
        For an object: which of its leaves meet, with the log odds that they are one.
    """

    number: int
    kind: Kind
    name: str
    parent: str | None
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

    def __repr__(self) -> str:
        return f"Step({self.number}, {self.kind} of {self.name!r}: {self.sentence})"


def steps_of(
    tree: SegmentationTree, judged: Iterable[JudgedSplit], config: SegmentationConfig
) -> tuple[Step, ...]:
    """Return the steps of a frame that was segmented by itself.

    Parameters
    ----------
    tree : SegmentationTree
        The frame's.
    judged : iterable of JudgedSplit
        What its `segment` passed to an observer.
    config : SegmentationConfig
        Its settings.

    Returns
    -------
    tuple of Step
        Growth first, the worst segment before others (section 3.3); then leaves that one surface explains,
        creases, protrusions, and objects of several leaves. Splits that were undone later are not in the
        tree, and neither here.
    """
    by_trial = {id(each.trial): each for each in judged}
    kinds = [(_kind(each, by_trial), each) for each in _in_order(tree, config.metric)]
    stages: tuple[tuple[Kind, ...], ...] = (("gap", "cut"), ("fold",), ("crease",), ("protrusion",))
    steps = [
        *(
            _step(tree, each, kind, by_trial, config)
            for stage in stages
            for kind, each in kinds
            if kind in stage
        ),
        *_merges(tree, config),
    ]
    return tuple(replace(step, number=number) for number, step in enumerate(steps, start=1))


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
        return _KINDS[segment.division]
    if segment.trial is None:
        return None
    return "fold" if judged[id(segment.trial)].folded else "cut"


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
    return Step(
        number=0,
        kind=kind,
        name=segment.name,
        parent=segment.parent,
        depth=segment.depth,
        whole=whole,
        parts=tuple(parts),
        metric=metric,
        ratio=ratio,
        ratio_max=config.ratio_max,
        kept=kept,
        sentence=sentence,
    )


def _part(name: str | None, side: int, fit: Fit, metric: Metric) -> Part:
    return Part(name, side, fit, None if fit.surface is None else fit.value(metric))


def _merges(tree: SegmentationTree, config: SegmentationConfig) -> Iterator[Step]:
    """Yield a step for each object of several leaves."""
    for number, thing in enumerate(tree.objects, start=1):
        if len(thing.leaves) == 1:
            continue
        leaves = [tree[name] for name in thing.leaves]
        pixels = np.concatenate([leaf.fit.pixels for leaf in leaves])
        reason = f"{len(leaves)} surfaces"
        own = [contact for contact in tree.contacts if {contact.first, contact.second} <= set(thing.leaves)]
        own.sort(key=lambda each: -each.log_odds)
        first = leaves[0]
        yield Step(
            number=0,
            kind="merge",
            name=first.name,
            parent=first.parent,
            depth=first.depth,
            whole=Part(None, 0, Fit(None, np.zeros(0), {}, reason, pixels), None),
            parts=tuple(_part(leaf.name, 0, leaf.fit, config.metric) for leaf in leaves),
            metric=config.metric,
            ratio=None,
            ratio_max=config.ratio_max,
            kept=False,
            sentence=words.merged(number, len(leaves), own),
            evidence=tuple(map(words.contact, own)),
        )


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
