"""Objects: surfaces that meet in a convex, flat or smooth crease belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.compiled import compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.contact import Meeting, in_contact, meetings
from nurbseg.segmentation.inverse_depth import DepthGrid
from nurbseg.segmentation.smooth import smooth_borders
from nurbseg.segmentation.surface import NurbsSurface


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
        Places along the border, and those of them where the surfaces agree.
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
    if not (config.merge_crease or config.merge_smooth):
        return (), ()
    found = meetings(labels, surfaces, grid.rays, gap_per_m=config.depth_gap_per_m)
    smooth: set[tuple[int, int]] = set()
    if config.merge_smooth:
        on_grid = labels[:: grid.step, :: grid.step]
        answers = smooth_borders(found, on_grid, grid, config)
        smooth = {(each.first, each.second) for each, yes in zip(found, answers, strict=True) if yes}
    return merged_objects(found, smooth, labels, names, config)


def merged_objects(
    found: Sequence[Meeting],
    smooth: set[tuple[int, int]],
    labels: NDArray[np.int32],
    names: Sequence[str],
    config: SegmentationConfig,
) -> tuple[tuple[SceneObject, ...], tuple[Contact, ...]]:
    """Merge surfaces by what was measured where they meet.

    Parameters
    ----------
    found : sequence of Meeting
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
    group = _merged(found, smooth, len(names), config).tolist()
    sizes = np.zeros(len(names) + 1, dtype=np.intp)
    _count(np.ascontiguousarray(labels), sizes)
    members: dict[int, list[int]] = {}
    for label in range(1, len(names) + 1):
        members.setdefault(group[label], []).append(label)
    # A group has the number of one of its labels.
    largest = sorted(members, key=lambda number: (-sizes[members[number]].sum(), number))
    objects = tuple(SceneObject(tuple(names[label - 1] for label in members[number])) for number in largest)
    contacts = tuple(
        _explained(each, (each.first, each.second) in smooth, names, group, config) for each in found
    )
    return objects, contacts


@compiled
def _count(labels: NDArray[np.int32], sizes: NDArray[np.intp]) -> None:
    """Add up the pixels of each label."""
    for label in labels.flat:
        sizes[label] += 1


def _merged(
    found: Sequence[Meeting], smooth: set[tuple[int, int]], count: int, config: SegmentationConfig
) -> NDArray[np.intp]:
    """Merge greedily; returns the number of each label's group, which is the least label in it."""
    group = np.arange(count + 1)
    pooled = {
        (each.first, each.second): (
            each.samples,
            each.touching,
            0.0 if (each.first, each.second) in smooth else each.concavity_sum,
            config.merge_crease or (each.first, each.second) in smooth,
        )
        for each in found
    }
    while True:
        candidates = [
            (concavity / touching, pair)
            for pair, (samples, touching, concavity, allowed) in pooled.items()
            if allowed and in_contact(samples, touching) and concavity < config.concavity_max * touching
        ]
        if not candidates:
            return group
        _, (kept, gone) = min(candidates)
        group[group == gone] = kept
        del pooled[kept, gone]
        for pair in [pair for pair in pooled if gone in pair]:
            other = pair[0] if pair[1] == gone else pair[1]
            joint = min(kept, other), max(kept, other)
            one, two = pooled.pop(pair), pooled.get(joint, (0, 0, 0.0, False))
            pooled[joint] = (one[0] + two[0], one[1] + two[1], one[2] + two[2], one[3] or two[3])


def _explained(
    meeting: Meeting,
    smooth: bool,
    names: Sequence[str],
    group: Sequence[int],
    config: SegmentationConfig,
) -> Contact:
    """Say in words why two surfaces are, or are not, one object."""
    merged = group[meeting.first] == group[meeting.second]
    touching = in_contact(meeting.samples, meeting.touching)
    concavity = meeting.concavity_sum / meeting.touching if meeting.touching else float("nan")
    if not touching:
        why = f"a gap: {meeting.touching} of {meeting.samples} places along the border touch"
    elif smooth:
        why = "a smooth border: one surface explains both sides"
    elif concavity < config.concavity_max:
        why = f"a convex or flat crease of {concavity:.2f}"
    else:
        why = f"a concave crease of {concavity:.2f}, {config.concavity_max:g} at most is merged"
    direct = touching and (smooth or (config.merge_crease and concavity < config.concavity_max))
    if merged and not direct:
        why = f"joined through other surfaces, in spite of {why}"
    elif not merged and direct:
        why = f"{why}, but their objects meet in a concave one"
    return Contact(
        first=names[meeting.first - 1],
        second=names[meeting.second - 1],
        merged=merged,
        reason=why,
        samples=meeting.samples,
        touching=meeting.touching,
        concavity=concavity,
        smooth=smooth,
    )


__all__ = ["Contact", "SceneObject", "merge_surfaces", "merged_objects"]
