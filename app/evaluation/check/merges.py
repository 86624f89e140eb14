"""Checks objects: the sum of evidence, the lengths of borders, and the merges that follow from them."""

from collections import Counter
from collections.abc import Iterator
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.evaluation.check.exported import ExportedFrame, Finding

#: Maximum width of a gap without labels in a border, pixels of an image of 640 columns.
_REACH_PX = 6
#: Half of the last digit of evidence.
_ROUNDING = 5e-4


def check_merges(frame: ExportedFrame) -> Iterator[Finding]:
    """Check the contacts of leaves, and the objects that follow from them."""
    object_of = {name: number for number, names in frame.objects.items() for name in names}
    leaves = {leaf.name for leaf in frame.leaves()}
    sound = True
    for contact in frame.tree.contacts:
        first, second, merged = contact.first, contact.second, contact.merged
        pair = f"{first}-{second}"
        together = first in object_of and object_of[first] == object_of.get(second)
        if first == second or not {first, second} <= leaves:
            yield frame.wrong(pair, "contact", "two leaves", f"{first} and {second}")
            sound = False
        elif merged != together:
            yield frame.wrong(pair, "merged", f"{together} by their objects", merged)
        if contact.evidence is None or contact.log_odds is None:
            # An earlier version did not write evidence.
            sound = False
            continue
        total = sum(contact.evidence.values())
        if not abs(total - contact.log_odds) <= _ROUNDING:
            expected = f"{total:.3f}, the sum of its evidence"
            yield frame.wrong(pair, "log_odds", expected, contact.log_odds)
    if sound and frame.objects:
        if frame.settings.independent:
            yield from _check_samples(frame)
        yield from _check_objects(frame)


def _check_samples(frame: ExportedFrame) -> Iterator[Finding]:
    """Count the samples of every border again."""
    name_of = {leaf.leaf: leaf.name for leaf in frame.leaves()}
    reach = max(1, round(_REACH_PX * frame.shape[1] / 640))
    counts = _crossings(frame.leaf_image, reach) + _crossings(frame.leaf_image.T, reach)
    # Labels of no leaf are found by another check.
    seen = {
        frozenset(name_of[label] for label in pair): count
        for pair, count in counts.items()
        if pair <= name_of.keys()
    }
    stored = {frozenset((each.first, each.second)): each.samples for each in frame.tree.contacts}
    for pair in sorted({*seen, *stored}, key=sorted):
        if stored.get(pair) != seen.get(pair):
            expected = f"{seen.get(pair)} samples in the image of the leaves"
            yield frame.wrong("-".join(sorted(pair)), "samples", expected, stored.get(pair))


def _crossings(labels: NDArray[np.uint16], reach: int) -> Counter[frozenset[int]]:
    """Count changes of the label along rows, across gaps of less than `reach` pixels."""
    counts: Counter[frozenset[int]] = Counter()
    empty = np.ones((labels.shape[0], labels.shape[1] - 1), dtype=np.bool_)
    for apart in range(1, min(reach, labels.shape[1] - 1) + 1):
        before, after = labels[:, :-apart], labels[:, apart:]
        found = empty & (before != after) & (before > 0) & (after > 0)
        pairs = np.stack([before[found], after[found]], axis=1).tolist()
        counts.update(map(frozenset, pairs))
        empty = empty[:, :-1] & (after[:, :-1] == 0)
    return counts


def _check_objects(frame: ExportedFrame) -> Iterator[Finding]:
    """Merge again, the likeliest two groups first, as long as they are likely enough; then join."""
    place = {leaf.name: n for n, leaf in enumerate(frame.leaves())}
    groups = {n: {name} for name, n in place.items()}
    # By the first leaves of two groups: sum of log odds, exact, and number of samples.
    between: dict[tuple[int, int], tuple[Fraction, int]] = {}
    for each in frame.tree.contacts:
        first, second = sorted((place[each.first], place[each.second]))
        samples = each.samples or 0
        between[first, second] = Fraction(round(1000 * (each.log_odds or 0.0)), 1000) * samples, samples
    least = Fraction(frame.settings.config.extended.log_odds_min)
    while True:
        # Among equal pairs, that of the first leaves.
        likeliest = max(between, key=lambda pair: (_mean(between[pair]), (-pair[0], -pair[1])), default=None)
        if likeliest is None or _mean(between[likeliest]) <= least:
            break
        kept, gone = likeliest
        groups[kept] |= groups.pop(gone)
        pooled: dict[tuple[int, int], tuple[Fraction, int]] = {}
        for pair, (odds, samples) in between.items():
            first, second = sorted(kept if each == gone else each for each in pair)
            if first != second:
                before = pooled.get((first, second), (Fraction(), 0))
                pooled[first, second] = before[0] + odds, before[1] + samples
        between = pooled
    for join in frame.tree.joins:
        pieces = [number for number, names in groups.items() if {join.first, join.second} & names]
        if len(pieces) < 2:
            leaves = f"{join.first}-{join.second}"
            yield frame.wrong(leaves, "joins", "leaves of two objects", "one object or none")
            continue
        groups[pieces[0]] |= groups.pop(pieces[1])
    stored = {frozenset(names) for names in frame.objects.values()}
    for group in sorted(sorted(names) for names in groups.values() if frozenset(names) not in stored):
        yield frame.wrong("", "objects", f"one of {', '.join(group)} by the log odds", "none")


def _mean(odds_and_samples: tuple[Fraction, int]) -> Fraction:
    odds, samples = odds_and_samples
    return odds / samples if samples else Fraction(-(10**9))
