"""Objects: surfaces merged by the evidence along their borders."""

import heapq
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.labels.images import label_sizes
from nurbseg.segmentation.objects.border_statistics import BorderStatistics, border_statistics
from nurbseg.segmentation.objects.evidence import DIGITS, ITEMS, evidence
from nurbseg.segmentation.objects.surface_statistics import surface_statistics
from nurbseg.segmentation.points.grid import DepthGrid
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable


@dataclass(frozen=True, slots=True)
class SceneObject:
    """Surfaces that were merged.

    Parameters
    ----------
    leaves : tuple of str
        Names of its leaves, in the order of the tree.
    """

    leaves: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Contact:
    """Two leaves whose borders meet, and whether they were merged.

    Parameters
    ----------
    first, second : str
        Names of the leaves.
    merged : bool
        Whether they are in the same object.
    reason : str
        Why, or why not.
    samples, touching : int
        Grid pixels along the border, and those where the surfaces agree.
    log_odds : float
        That the two are one object, from this pair alone.
    evidence : mapping of str to float
        Terms of the log odds, by name, but for those that are 0.
    """

    first: str
    second: str
    merged: bool
    reason: str
    samples: int
    touching: int
    log_odds: float
    evidence: Mapping[str, float]


def merge_surfaces(
    labels: NDArray[np.int32],
    grid: DepthGrid,
    names: Sequence[str],
    surfaces: SurfaceTable,
    config: SegmentationConfig,
) -> tuple[tuple[SceneObject, ...], tuple[Contact, ...]]:
    """Merge adjacent surfaces into objects.

    Each pair that meets has log odds of being one object (see `evidence`). The pair with the largest is
    merged, and its log odds with others are averaged, weighted by the lengths of the borders, until no pair
    is likely enough [1]_.

    Parameters
    ----------
    labels : (H, W) int32
        1 to the number of surfaces; 0 where there is no point.
    grid : DepthGrid
        The points.
    names : sequence of str
        Of the leaf of each label.
    surfaces : SurfaceTable
        Those of the labels.
    config : SegmentationConfig
        Whether to merge, the least log odds, noise and gap.

    Returns
    -------
    objects : tuple of SceneObject
        Largest first; empty if merging is off.
    contacts : tuple of Contact
        Of all leaves whose borders meet.

    References
    ----------
    .. [1] A. Bailoni et al., "GASP, a generalized framework for agglomerative clustering of signed graphs",
       CVPR 2022.
    """
    extended = config.extended
    if not extended.merge_surfaces:
        return (), ()
    borders = border_statistics(labels, surfaces.slopes, grid.rays, gap_per_m=extended.inverse_depth_gap)
    measured = surface_statistics(labels[:: grid.step, :: grid.step], len(names), grid)
    items = evidence(borders, measured, extended.inverse_depth_noise)
    return merged_objects(borders, items, labels, names, config)


def merged_objects(
    borders: BorderStatistics,
    items: NDArray[np.float64],
    labels: NDArray[np.int32],
    names: Sequence[str],
    config: SegmentationConfig,
) -> tuple[tuple[SceneObject, ...], tuple[Contact, ...]]:
    """Merge surfaces by the evidence along their borders.

    Parameters
    ----------
    borders : BorderStatistics
        Of every two labels whose borders meet; samples are whole numbers.
    items : (P, 9) float64
        Terms of the log odds of each pair, as `evidence` returns them.
    labels : (H, W) int32
        1 to the number of surfaces; on all pixels, or evenly on some of them.
    names : sequence of str
        Of the leaf of each label.
    config : SegmentationConfig
        The least log odds.

    Returns
    -------
    objects, contacts
        As those of `merge_surfaces`.
    """
    least = config.extended.log_odds_min
    pairs, log_odds = borders.labels.tolist(), np.round(items.sum(axis=1), DIGITS).tolist()
    samples, touching = (each.astype(np.int64).tolist() for each in (borders.samples, borders.touching))
    group = agglomerate(pairs, log_odds, samples, len(names), least)
    members: dict[int, list[int]] = {}
    for label, number in enumerate(group[1:], start=1):
        members.setdefault(number, []).append(label)
    contacts = []
    columns = pairs, samples, touching, log_odds, items.tolist()
    for (first, second), length, touches, odds, own in zip(*columns, strict=True):
        merged, likely = group[first] == group[second], odds > least
        terms = {name: item for name, item in zip(ITEMS, own, strict=True) if item}
        why = _in_words(terms, odds, length, touches)
        if merged and not likely:
            why = f"merged through other surfaces, despite {why}"
        elif not merged and likely:
            why = f"{why}, but the average over their objects' borders is too low"
        contacts.append(
            Contact(names[first - 1], names[second - 1], merged, why, length, touches, odds, terms)
        )
    return largest_first(members.values(), label_sizes(labels, len(names) + 1), names), tuple(contacts)


def largest_first(
    groups: Iterable[list[int]], sizes: NDArray[np.int64], names: Sequence[str]
) -> tuple[SceneObject, ...]:
    """Make objects of groups of labels, given the size of each label, and the names of the leaves."""
    ordered = sorted(groups, key=lambda labels: (-sizes[labels].sum(), labels))
    return tuple(SceneObject(tuple(names[label - 1] for label in labels)) for labels in ordered)


def agglomerate(
    pairs: Sequence[Sequence[int]],
    log_odds: Sequence[float],
    samples: Sequence[int],
    count: int,
    log_odds_min: float = 0.0,
) -> list[int]:
    """Merge the most likely pair of groups, as long as it is likely enough.

    Parameters
    ----------
    pairs : sequence of (int, int)
        Labels that meet, the smaller one first, each pair once.
    log_odds : sequence of float
        Of each pair, to `DIGITS` digits.
    samples : sequence of int
        Length of each border, more than 0: its weight in the average over the borders of two groups.
    count : int
        Number of labels, from 1 on.
    log_odds_min : float
        Groups are merged if theirs are more than this.

    Returns
    -------
    list of int
        The smallest label of each label's group; 0 of 0. Of equally likely pairs, that of the smallest
        labels is first.
    """
    group, scale = list(range(count + 1)), 10**DIGITS
    # Sums of whole numbers do not depend on the order in which they are added.
    joint: list[dict[int, tuple[int, int]]] = [{} for _ in group]
    queue: list[tuple[float, int, int, int, int]] = []

    def judge(one: int, other: int, total: int, length: int) -> None:
        joint[one][other] = joint[other][one] = total, length
        if total > log_odds_min * scale * length:
            first, second = (one, other) if one < other else (other, one)
            heapq.heappush(queue, (-total / length, first, second, total, length))

    for (first, second), odds, length in zip(pairs, log_odds, samples, strict=True):
        judge(first, second, round(odds * scale) * length, length)
    while queue:
        _, kept, gone, *sums = heapq.heappop(queue)
        # Skip pairs that have changed since.
        if joint[kept].get(gone) != tuple(sums):
            continue
        del joint[kept][gone], joint[gone][kept]
        group = [kept if each == gone else each for each in group]
        for other, (total, length) in joint[gone].items():
            del joint[other][gone]
            more = joint[kept].get(other, (0, 0))
            judge(kept, other, total + more[0], length + more[1])
        joint[gone] = {}
    return group


def _in_words(weighed: Mapping[str, float], log_odds: float, samples: int, touching: int) -> str:
    if "gap" in weighed:
        return f"a gap: the surfaces touch at {touching} of {samples} samples of the border"
    by_weight = sorted((item, name) for name, item in weighed.items() if name != "base")
    most = by_weight[-1:] + by_weight[:-1][:1]
    terms = " and ".join(f"{name} {item:+.1f}" for item, name in most)
    return f"log odds of {log_odds:+.2f}, of which {terms}" if terms else f"log odds of {log_odds:+.2f}"
