"""Checks that a tree, its label images and its objects agree on names, sizes, labels and merges."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from nurbseg.evaluation.check.evidence import check_merges_again
from nurbseg.evaluation.check.exported import ExportedFrame

#: Maximum width of a gap without labels in a border, pixels of an image of 640 columns.
_REACH_PX = 6


def check_names(frame: ExportedFrame) -> None:
    """Check names, parents, children, depths and the order of segments."""
    waiting, reached = ["P"], list[str]()
    while waiting and len(reached) <= len(frame.segments):
        reached.append(waiting.pop())
        if reached[-1] in frame.segments:
            waiting.extend(reversed(frame.segments[reached[-1]].children))
    frame.compare("", "segments", reached, list(frame.segments), " (depth first)")
    for name, segment in frame.segments.items():
        frame.compare(name, "parent", name[:-1] or None, segment.parent)
        frame.compare(
            name, "children", (f"{name}0", f"{name}1") if segment.children else (), segment.children
        )
        frame.compare(name, "depth", len(name) - 1, segment.depth)


def check_partition(frame: ExportedFrame) -> None:
    """Check sizes, labels and objects against the label images.

    Labels are positions in the tree or, if frames continue each other, identities.
    """
    in_order = not frame.settings.temporal
    counts = np.bincount(frame.leaf_image.ravel(), minlength=1 << 16)
    known = {0}
    for place, leaf in enumerate(frame.leaves, start=1):
        label = leaf.leaf or 0
        if in_order:
            frame.compare(leaf.name, "leaf", place, leaf.leaf, ", its place among the leaves")
        if label in known and (label > 0 or leaf.size > 0):
            frame.wrong(leaf.name, "leaf", "a label of its own", leaf.leaf)
            continue
        known.add(label)
        pixels = int(counts[label]) if 0 < label < counts.size else 0
        frame.compare(leaf.name, "size", pixels, leaf.size, ", the pixels of its label")
    for label in sorted(set(np.flatnonzero(counts).tolist()) - known):
        file = "surfaces.png" if frame.objects else "labels.png"
        frame.wrong("", f"label {label}", "a leaf of the tree", f"{counts[label]} pixels of none", file)
    by_object = bool(frame.objects) and frame.tree.level != "surfaces"
    for name, segment in frame.segments.items():
        frame.compare(name, "label", segment.object if by_object else segment.leaf, segment.label)
        if segment.children:
            total = sum(frame.segments[child].size for child in segment.children)
            frame.compare(name, "size", total, segment.size, ", the sum of its children")
            frame.compare(name, "leaf", None, segment.leaf, ", it is no leaf")
            frame.compare(name, "object", None, segment.object, ", it is no leaf")
    _check_objects(frame, in_order)


def _check_objects(frame: ExportedFrame, in_order: bool) -> None:
    listed = sorted(name for names in frame.objects.values() for name in names)
    leaves = sorted(leaf.name for leaf in frame.leaves)
    if frame.objects and listed != leaves:
        frame.wrong("", "objects", f"each of the leaves {leaves} once", listed)
    if in_order and list(frame.objects) != list(range(1, len(frame.objects) + 1)):
        frame.wrong("", "objects", "the numbers 1, 2, ...", list(frame.objects))
    # The numbers of a damaged file may be of any size.
    label_of = np.zeros(1 << 16, dtype=np.int64)
    for leaf in frame.leaves:
        number = frame.object_of.get(leaf.name)
        frame.compare(leaf.name, "object", number, leaf.object)
        if leaf.leaf and 0 < leaf.leaf < label_of.size:
            label_of[leaf.leaf] = number if number and abs(number) < 1 << 16 else 0
    if not frame.objects:
        return
    objects = label_of[frame.leaf_image]
    labels = frame.leaf_image if frame.tree.level == "surfaces" else objects
    for file, image in (("objects", objects), ("labels", labels)):
        wrong = np.argwhere(frame.images[file] != image)
        if wrong.size:
            row, column = wrong[0].tolist()
            where = f"pixel [{row}, {column}] and {len(wrong) - 1} others"
            found = frame.images[file][row, column]
            frame.wrong("", where, f"{image[row, column]}, that of its leaf", found, f"{file}.png")


def check_merges(frame: ExportedFrame) -> None:
    """Check the contacts of leaves, and the objects that follow from them."""
    leaves = {leaf.name for leaf in frame.leaves}
    sound = True
    for contact in frame.tree.contacts:
        first, second = contact.first, contact.second
        pair = f"{first}-{second}"
        if first == second or not {first, second} <= leaves:
            frame.wrong(pair, "contact", "two leaves", f"{first} and {second}")
            sound = False
        else:
            together = first in frame.object_of and frame.object_of[first] == frame.object_of.get(second)
            frame.compare(pair, "merged", together, contact.merged, " by their objects")
    if sound and frame.objects:
        _check_samples(frame)
        check_merges_again(frame)


def _check_samples(frame: ExportedFrame) -> None:
    """Count the samples of every border again."""
    name_of = {leaf.leaf: leaf.name for leaf in frame.leaves}
    reach = max(1, round(_REACH_PX * frame.shape[1] / 640))
    counts = _crossings(frame.leaf_image, reach) + _crossings(frame.leaf_image.T, reach)
    # Labels of no leaf are found by another check.
    seen = {
        frozenset(name_of[label] for label in pair): count
        for pair, count in counts.items()
        if pair <= name_of.keys()
    }
    stored = {frozenset((contact.first, contact.second)): contact.samples for contact in frame.tree.contacts}
    for pair in sorted({*seen, *stored}, key=sorted):
        name, why = "-".join(sorted(pair)), " samples in the image of the leaves"
        frame.compare(name, "samples", seen.get(pair), stored.get(pair), why)


def _crossings(labels: NDArray[np.uint16], reach: int) -> Counter[frozenset[int]]:
    """Count changes of the label along rows, across gaps of less than `reach` pixels."""
    counts: Counter[frozenset[int]] = Counter()
    empty = np.ones((labels.shape[0], labels.shape[1] - 1), dtype=np.bool_)
    for apart in range(1, min(reach, labels.shape[1] - 1) + 1):
        before, after = labels[:, :-apart], labels[:, apart:]
        found = empty & (before != after) & (before > 0) & (after > 0)
        counts.update(map(frozenset, np.stack([before[found], after[found]], axis=1).tolist()))
        empty = empty[:, :-1] & (after[:, :-1] == 0)
    return counts
