"""Whether a tree, its label images and its objects say the same: names, sums, and one leaf for each pixel."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedSegment, Finding


def check_names(frame: ExportedFrame) -> Iterator[Finding]:
    """Check names, parents, children, depths and the order of segments: whether the tree is one tree."""
    waiting, reached = ["P"], []
    while waiting:
        reached.append(waiting.pop())
        each = frame.segments.get(reached[-1])
        if each is not None:
            waiting.extend(reversed(each.children))
            if len(reached) > len(frame.segments):
                break
    if reached != list(frame.segments):
        yield Finding(frame.tree_file, "", "segments", f"{reached} (depth first)", f"{list(frame.segments)}")
    for name, each in frame.segments.items():
        children = (f"{name}0", f"{name}1") if each.children else ()
        for field, expected, found in (
            ("parent", name[:-1] or None, each.parent),
            ("children", children, each.children),
            ("depth", len(name) - 1, each.depth),
        ):
            if found != expected:
                yield Finding(frame.tree_file, name, field, str(expected), str(found))


def check_partition(frame: ExportedFrame) -> Iterator[Finding]:
    """Check sizes, labels and objects against the label images.

    Labels are places in the tree, or identities where frames continue each other.
    """
    tree, image, in_order = frame.tree_file, frame.leaf_image, not frame.settings.temporal
    counts = np.bincount(image.ravel(), minlength=1 << 16)
    known = {0}
    for place, leaf in enumerate(frame.leaves(), start=1):
        label = leaf.leaf or 0
        if in_order and label != place:
            yield Finding(tree, leaf.name, "leaf", f"{place}, its place among the leaves", str(leaf.leaf))
        if label in known and (label > 0 or leaf.size > 0):
            yield Finding(tree, leaf.name, "leaf", "a label of its own", str(leaf.leaf))
            continue
        known.add(label)
        pixels = int(counts[label]) if 0 < label < counts.size else 0
        if leaf.size != pixels:
            yield Finding(tree, leaf.name, "size", f"{pixels}, the pixels of its label", str(leaf.size))
    for label in sorted(set(np.flatnonzero(counts).tolist()) - known):
        file = f"{frame.stem}_{'surfaces' if frame.objects else 'labels'}.png"
        yield Finding(file, "", f"label {label}", "a leaf of the tree", f"{counts[label]} pixels of none")
    for name, each in frame.segments.items():
        if each.children:
            total = sum(frame.segments[child].size for child in each.children)
            if each.size != total:
                yield Finding(tree, name, "size", f"{total}, the sum of its children", str(each.size))
        yield from _labels_of(frame, each)
    yield from _check_objects(frame, in_order)


def _labels_of(frame: ExportedFrame, each: ExportedSegment) -> Iterator[Finding]:
    """Say which of a segment's three labels are not what they follow from."""
    by_object = bool(frame.objects) and frame.tree.level != "surfaces"
    expected = each.object if by_object else each.leaf
    if each.label != expected:
        yield Finding(frame.tree_file, each.name, "label", str(expected), str(each.label))
    if not each.children:
        return
    for field, value in (("leaf", each.leaf), ("object", each.object)):
        if value is not None:
            yield Finding(frame.tree_file, each.name, field, "None, it is no leaf", str(value))


def _check_objects(frame: ExportedFrame, in_order: bool) -> Iterator[Finding]:
    tree = frame.tree_file
    object_of = {name: number for number, names in frame.objects.items() for name in names}
    listed = [name for names in frame.objects.values() for name in names]
    leaves = [leaf.name for leaf in frame.leaves()]
    if frame.objects and sorted(listed) != sorted(leaves):
        yield Finding(tree, "", "objects", f"each of the leaves {sorted(leaves)} once", f"{sorted(listed)}")
    if in_order and list(frame.objects) != list(range(1, len(frame.objects) + 1)):
        yield Finding(tree, "", "objects", "the numbers 1, 2, ...", f"{list(frame.objects)}")
    label_of = np.zeros(1 << 16, dtype=np.uint16)
    for leaf in frame.leaves():
        if leaf.object != object_of.get(leaf.name):
            yield Finding(tree, leaf.name, "object", str(object_of.get(leaf.name)), str(leaf.object))
        if leaf.leaf and 0 < leaf.leaf < label_of.size:
            label_of[leaf.leaf] = object_of.get(leaf.name, 0)
    expected = {"objects": label_of[frame.leaf_image]} if frame.objects else {}
    if frame.objects:
        expected["labels"] = expected["objects"] if frame.tree.level != "surfaces" else frame.leaf_image
    for kind, image in expected.items():
        wrong = np.argwhere(frame.images[kind] != image)
        if wrong.size:
            row, column = wrong[0].tolist()
            yield Finding(
                f"{frame.stem}_{kind}.png",
                "",
                f"pixel [{row}, {column}] and {len(wrong) - 1} others",
                f"{image[row, column]}, that of its leaf",
                str(frame.images[kind][row, column]),
            )
