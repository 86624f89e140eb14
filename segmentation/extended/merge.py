"""Objects: surfaces that meet in a convex, flat or smooth crease belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.border_statistics import BorderStatistics, border_statistics, in_contact
from nurbseg.segmentation.extended.smooth import smooth_borders
from nurbseg.segmentation.points.depth_grid import DepthGrid
from nurbseg.segmentation.surfaces.surface import NurbsSurface


@dataclass(frozen=True, slots=True)
class SceneObject:
    """Surfaces that belong together.

    Parameters
    ----------
    leaves : tuple of str
        Names of the leaves that it consists of, in the order of the tree.
    """

    leaves: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Contact:
    """Two leaves whose borders meet, and what became of them.

    Parameters
    ----------
    first, second : str
        Names of the leaves.
    merged : bool
        Whether they are in one object in the end.
    reason : str
        Why, or why not.
    samples, touching : int
        Grid pixels along the border, and those of them where the surfaces agree.
    concavity : float
        Mean turn of the normals towards each other where they touch, about radians, negative for a convex
        crease; NaN where they touch nowhere.
    smooth : bool
        Whether one surface explains both sides of a concave border.
    """

    first: str
    second: str
    merged: bool
    reason: str
    samples: int
    touching: int
    concavity: float
    smooth: bool


def merge_surfaces(
    labels: NDArray[np.int32],
    grid: DepthGrid,
    names: Sequence[str],
    surfaces: Sequence[NurbsSurface | None],
    config: SegmentationConfig,
) -> tuple[tuple[SceneObject, ...], tuple[Contact, ...]]:
    """Merge adjacent surfaces into objects.

    Of all pairs in contact the one with the least concavity is merged first, and its borders with others
    are pooled, until all that is left is more concave than allowed. A concave border that a single surface
    explains as well as two is smooth, the inside of a bowl rather than a box on a table: it counts as flat.

    Parameters
    ----------
    labels : (H, W) int32
        1 to the number of surfaces; 0 where there is no point.
    grid : DepthGrid
        The points.
    names : sequence of str
        Of the leaf of each label.
    surfaces : sequence of NurbsSurface or None
        That of each label.
    config : SegmentationConfig
        What is merged, up to which concavity, and what a gap is.

    Returns
    -------
    objects : tuple of SceneObject
        The one with most pixels first; empty where merging is off.
    contacts : tuple of Contact
        Of all leaves whose borders meet.

    References
    ----------
    .. [1] S. C. Stein et al., "Object partitioning using local convexity", CVPR 2014.
    """
    if not (config.extended.merge_crease or config.extended.merge_smooth):
        return (), ()
    found = border_statistics(labels, surfaces, grid.rays, gap_per_m=config.extended.inverse_depth_gap)
    smooth: set[tuple[int, int]] = set()
    if config.extended.merge_smooth:
        on_grid = labels[:: grid.step, :: grid.step]
        answers = smooth_borders(found, on_grid, grid, config)
        smooth = {(each.first, each.second) for each, yes in zip(found, answers, strict=True) if yes}
    return merged_objects(found, smooth, labels, names, config)


def merged_objects(
    found: Sequence[BorderStatistics],
    smooth: set[tuple[int, int]],
    labels: NDArray[np.int32],
    names: Sequence[str],
    config: SegmentationConfig,
) -> tuple[tuple[SceneObject, ...], tuple[Contact, ...]]:
    """Merge surfaces by what was measured where they meet.

    Parameters
    ----------
    found : sequence of BorderStatistics
        Of every two labels whose borders meet.
    smooth : set of (int, int)
        Labels, the smaller one first, that meet in a smooth border.
    labels : (H, W) int32
        1 to the number of surfaces; on all pixels, or evenly on some of them.
    names : sequence of str
        Of the leaf of each label.
    config : SegmentationConfig
        What is merged, and up to which concavity.

    Returns
    -------
    objects, contacts
        As those of `merge_surfaces`.
    """
    group = _merged(found, smooth, len(names), config)
    counts = np.zeros(len(names) + 1, dtype=np.intp)
    _count(np.ascontiguousarray(labels), counts)
    sizes = counts.tolist()
    members: dict[int, list[int]] = {}
    for label in range(1, len(names) + 1):
        members.setdefault(group[label], []).append(label)
    pixels = {number: sum(sizes[label] for label in members[number]) for number in members}
    largest = sorted(members, key=lambda number: (-pixels[number], number))
    objects = tuple(SceneObject(tuple(names[label - 1] for label in members[number])) for number in largest)
    contacts = tuple(
        _explained(each, (each.first, each.second) in smooth, names, group, config) for each in found
    )
    return objects, contacts


@compiled
def _count(labels: NDArray[np.int32], counts: NDArray[np.intp]) -> None:
    """Add up the pixels of each label."""
    for label in labels.flat:
        counts[label] += 1


def _merged(
    found: Sequence[BorderStatistics], smooth: set[tuple[int, int]], count: int, config: SegmentationConfig
) -> list[int]:
    """Merge greedily; returns the number of each label's group, which is one of the labels in it."""
    group = list(range(count + 1))
    pooled = {}
    for each in found:
        pair = each.first, each.second
        is_smooth = pair in smooth
        pooled[pair] = _Pooled(
            each.samples,
            each.touching,
            0.0 if is_smooth else each.concavity_sum,
            config.extended.merge_crease or is_smooth,
        )
    mergeable: dict[tuple[int, int], float] = {}

    def judge(pair: tuple[int, int]) -> None:
        concavity = pooled[pair].concavity()
        if concavity < config.extended.concavity_max:
            mergeable[pair] = concavity

    for pair in pooled:
        judge(pair)
    while mergeable:
        _, (kept, gone) = min(zip(mergeable.values(), mergeable, strict=True))
        group = [kept if each == gone else each for each in group]
        del pooled[kept, gone], mergeable[kept, gone]
        for pair in [pair for pair in pooled if gone in pair]:
            other = pair[0] if pair[1] == gone else pair[1]
            joint = (kept, other) if kept < other else (other, kept)
            mergeable.pop(pair, None)
            mergeable.pop(joint, None)
            pooled[joint] = pooled.pop(pair) + pooled.get(joint, _Pooled(0, 0, 0.0, False))
            judge(joint)
    return group


@dataclass(frozen=True, slots=True)
class _Pooled:
    """What was measured along all borders of two groups, and whether one of them may be merged."""

    samples: int
    touching: int
    concavity_sum: float
    allowed: bool

    def __add__(self, other: _Pooled) -> _Pooled:
        return _Pooled(
            self.samples + other.samples,
            self.touching + other.touching,
            self.concavity_sum + other.concavity_sum,
            self.allowed or other.allowed,
        )

    def concavity(self) -> float:
        """Return the mean turn of the normals, infinite where the groups are not to be merged."""
        if self.allowed and in_contact(self.samples, self.touching):
            return self.concavity_sum / self.touching
        return inf


def _explained(
    border: BorderStatistics,
    smooth: bool,
    names: Sequence[str],
    group: Sequence[int],
    config: SegmentationConfig,
) -> Contact:
    """Say in words why two surfaces are, or are not, one object."""
    merged = group[border.first] == group[border.second]
    touching = in_contact(border.samples, border.touching)
    concavity = border.concavity_sum / border.touching if border.touching else float("nan")
    if not touching:
        why = f"a gap: {border.touching} of {border.samples} places along the border touch"
    elif smooth:
        why = "a smooth border: one surface explains both sides"
    elif concavity < config.extended.concavity_max:
        why = f"a convex or flat crease of {concavity:.2f}"
    else:
        why = f"a concave crease of {concavity:.2f}, {config.extended.concavity_max:g} at most is merged"
    direct = touching and (
        smooth or (config.extended.merge_crease and concavity < config.extended.concavity_max)
    )
    if merged and not direct:
        why = f"joined through other surfaces, in spite of {why}"
    elif not merged and direct:
        why = f"{why}, but their objects meet in a concave one"
    return Contact(
        first=names[border.first - 1],
        second=names[border.second - 1],
        merged=merged,
        reason=why,
        samples=border.samples,
        touching=border.touching,
        concavity=concavity,
        smooth=smooth,
    )
