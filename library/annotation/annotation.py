"""A segmented frame whose objects a person corrects."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial, reduce
from itertools import count, islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.annotation.files import save_labels
from nurbseg.library.notebook import show
from nurbseg.library.result import FrameResult, new_tracker
from nurbseg.segmentation.config import Level
from nurbseg.segmentation.extended.forced import split_anyway
from nurbseg.segmentation.live.identity import Identities
from nurbseg.segmentation.objects.merge import SceneObject
from nurbseg.segmentation.segments import Segment, SegmentationTree

#: A leaf by its name, or two groups of leaves that were merged.
Group = str | tuple["Group", "Group"]


class Annotation:
    """The objects of a frame, for a person to correct; the result that it begins with stays as it is.

    Parameters
    ----------
    result : FrameResult
        The frame. Where surfaces are not merged into objects, each surface is one.
    """

    def __init__(self, result: FrameResult) -> None:
        if not isinstance(result, FrameResult):
            raise TypeError(f"result: expected a FrameResult, as of segment, got {type(result).__name__}")
        self._states: list[tuple[FrameResult, Mapping[int, Group]]] = [(result, _groups_of(result))]

    def __repr__(self) -> str:
        frame = self.result.frame.index
        return f"Annotation(frame {frame}, {len(self.objects)} objects, {self.corrections} corrections)"

    @property
    def corrections(self) -> int:
        """Number of corrections that `undo` can take back."""
        return len(self._states) - 1

    @property
    def result(self) -> FrameResult:
        """The frame as it is corrected, to be measured, drawn and exported like any other.

        Once something is corrected, its tree no longer has the evidence for and against merging.
        """
        return self._states[-1][0]

    @property
    def objects(self) -> tuple[int, ...]:
        """Labels of the objects, ascending."""
        return tuple(sorted(self._groups))

    @property
    def labels(self) -> NDArray[np.uint16]:
        """Label of each pixel's object, (H, W) uint16; 0 without depth."""
        return self.result.labels("objects")

    def merge(self, *labels: int) -> int:
        """Make one object of several, which need not touch; return its label, which is that of the first.

        Raises
        ------
        ValueError
            If these are not several objects of the frame.
        """
        if len(set(labels)) < 2 or len(set(labels)) < len(labels):
            raise ValueError(
                f"expected two or more objects to merge, got {' '.join(map(str, labels)) or 'none'}"
            )
        groups = dict(self._groups)
        merged = reduce(lambda one, other: (one, other), [groups.pop(self._known(label)) for label in labels])
        self._add(self.result.tree.segments, groups | {labels[0]: merged})
        return labels[0]

    def split(self, label: int) -> tuple[int, ...]:
        """Split an object where its parts were merged last, or its only surface by the next normalized cut.

        Returns
        -------
        (int, int)
            The labels of both parts: the larger one keeps its own, the other gets the least that is free.

        Raises
        ------
        ValueError
            If there is no such object, or its surface is too small to be cut.
        """
        group, segments = self._groups[self._known(label)], self.result.tree.segments
        if isinstance(group, str):
            segments = _divided(self.result, group)
            group = _group_below(group, {segment.name: segment for segment in segments})
        if isinstance(group, str):
            raise ValueError(f"object {label} is one surface, which is too small to be cut")
        return self._parted(label, group, segments)

    def take_apart(self, label: int) -> tuple[int, ...]:
        """Make an object of each surface of one, and return their labels: the largest keeps its own.

        Raises
        ------
        ValueError
            If there is no such object, or it is one surface.
        """
        surfaces = tuple(_leaves(self._groups[self._known(label)]))
        if len(surfaces) == 1:
            raise ValueError(f"object {label} is one surface; it can only be split in two")
        return self._parted(label, surfaces, self.result.tree.segments)

    def undo(self) -> None:
        """Take the last correction back.

        Raises
        ------
        ValueError
            If there is none.
        """
        if not self.corrections:
            raise ValueError("nothing was corrected")
        self._states.pop()

    def save(self, folder: str | Path) -> Path:
        """Write the labels with the frame's images and camera, as `nurbseg.library.annotation.files` says.

        Returns
        -------
        Path
            The label image, ``NAME_label.png``.
        """
        return save_labels(self.result, Path(folder))

    def picture(self) -> NDArray[np.uint8]:
        """Return the frame with its objects outlined and numbered, (H, W, 3) uint8 RGB."""
        return self.result.picture()

    def show(self) -> None:
        """Show the picture in a notebook, also within a loop; raises RuntimeError where there is none."""
        show(self, "picture() returns the image as an array")

    def _repr_png_(self) -> bytes:
        """Return the picture as PNG: notebooks show it."""
        return self.result._repr_png_()

    @property
    def _groups(self) -> Mapping[int, Group]:
        return self._states[-1][1]

    def _parted(self, label: int, parts: Sequence[Group], segments: tuple[Segment, ...]) -> tuple[int, ...]:
        """Put parts in place of an object, and return their labels, largest part first."""
        pixels = {segment.name: segment.pixels.size for segment in segments}
        parts = sorted(parts, key=lambda part: -sum(pixels[name] for name in _leaves(part)))
        free = (each for each in count(1) if each not in self._groups)
        labels = (label, *islice(free, len(parts) - 1))
        self._add(segments, {**self._groups, **dict(zip(labels, parts, strict=True))})
        return labels

    def _known(self, label: int) -> int:
        if label not in self._groups:
            raise ValueError(f"no object {label} in this frame, but {', '.join(map(str, self.objects))}")
        return label

    def _add(self, segments: tuple[Segment, ...], groups: Mapping[int, Group]) -> None:
        self._states.append((_corrected(self.result, segments, groups), groups))


def _groups_of(result: FrameResult) -> dict[int, Group]:
    """Return the leaves of each object by its label, grouped in the order in which they were merged."""
    tree = result.tree
    merged: dict[str, Group] = {leaf.name: leaf.name for leaf in tree.leaves() if leaf.pixels.size}
    if not tree.objects:
        labels = {leaf.name: label for leaf, label in zip(tree.leaves(), result.surface_labels, strict=True)}
        return {labels[name]: group for name, group in merged.items()}
    for merge in tree.merges:
        if merge.merged and merge.first in merged and merge.second in merged:
            merged[merge.first] = merged[merge.first], merged.pop(merge.second)
    groups: dict[int, Group] = {}
    for label, thing in zip(result.object_labels, tree.objects, strict=True):
        # Several in a thing, whose objects were joined, and in what was corrected before.
        own = [merged[name] for name in thing.leaves if name in merged]
        if own:
            groups[label] = reduce(lambda one, other: (one, other), own)
    return groups


def _leaves(group: Group) -> Iterator[str]:
    if isinstance(group, str):
        yield group
    else:
        for part in group:
            yield from _leaves(part)


def _group_below(name: str, segments: Mapping[str, Segment]) -> Group:
    """Return the leaves below a segment, but for those that have no pixels, as the tree groups them."""
    parts = [
        _group_below(child, segments) for child in segments[name].children if segments[child].pixels.size
    ]
    return reduce(lambda one, other: (one, other), parts) if parts else name


def _divided(result: FrameResult, name: str) -> tuple[Segment, ...]:
    """Return the segments of a frame with a leaf divided."""
    tree = result.tree
    below = split_anyway(result.cloud, tree[name], result.config)
    place = [segment.name for segment in tree.segments].index(name)
    segments = (*tree.segments[:place], *below, *tree.segments[place + 1 :])
    leaves = [segment for segment in segments if segment.is_leaf]
    return tuple(
        # Pixels are in the order of leaves.
        replace(
            segment,
            pixels=np.concatenate([leaf.pixels for leaf in leaves if leaf.name.startswith(segment.name)]),
        )
        if name.startswith(segment.name)
        else segment
        for segment in segments
    )


def _corrected(
    result: FrameResult, segments: tuple[Segment, ...], groups: Mapping[int, Group]
) -> FrameResult:
    """Return a frame with other segments and objects, whose labels stay as they are."""
    before = dict(zip((leaf.name for leaf in result.tree.leaves()), result.surface_labels, strict=True))
    tree = SegmentationTree(segments, result.tree.shape)
    leaves = tree.leaves()
    place = {leaf.name: n for n, leaf in enumerate(leaves)}
    sizes = [leaf.pixels.size for leaf in leaves]
    things = {label: sorted(_leaves(group), key=place.__getitem__) for label, group in groups.items()}
    of_size = {label: sum(sizes[place[name]] for name in names) for label, names in things.items()}
    ordered = sorted(things, key=lambda label: (-of_size[label], label))
    objects = [SceneObject(tuple(things[label])) for label in ordered]
    # Leaves without pixels are in no group.
    rest = place.keys() - {name for names in things.values() for name in names}
    objects += [SceneObject((name,)) for name in sorted(rest)]
    level: Level = "things" if result.tree.level == "things" else "objects"
    tree = replace(tree, objects=tuple(objects), level=level, image=tree.labels("surfaces"))
    free = (each for each in count(1) if each not in before.values())
    surfaces = {n: before.get(leaf.name) or next(free) for n, leaf in enumerate(leaves, start=1)}
    return replace(
        result,
        tree=tree,
        surface_identities=_identities(surfaces),
        object_identities=_identities(dict(enumerate(ordered, start=1))),
        tracker=cache(partial(new_tracker, result.config)),
    )


def _identities(of_label: Mapping[int, int]) -> Identities:
    return Identities(of_label, np.zeros((1, 1), dtype=np.uint16))
