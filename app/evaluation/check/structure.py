"""Checks that a tree, its label images and its objects agree on names, sizes and labels."""

from collections.abc import Iterator

import numpy as np

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedSegment, Finding


def check_names(frame: ExportedFrame) -> Iterator[Finding]:
    """Check names, parents, children, depths and the order of segments."""
    waiting, reached = ["P"], []
    while waiting:
        reached.append(waiting.pop())
        each = frame.segments.get(reached[-1])
        if each is not None:
            waiting.extend(reversed(each.children))
            if len(reached) > len(frame.segments):
                break
    if reached != list(frame.segments):
        yield frame.wrong("", "segments", f"{reached} (depth first)", list(frame.segments))
    for name, each in frame.segments.items():
        children = (f"{name}0", f"{name}1") if each.children else ()
        for field, expected, found in (
            ("parent", name[:-1] or None, each.parent),
            ("children", children, each.children),
            ("depth", len(name) - 1, each.depth),
        ):
            if found != expected:
                yield frame.wrong(name, field, expected, found)


def check_partition(frame: ExportedFrame) -> Iterator[Finding]:
    """Check sizes, labels and objects against the label images.

    Labels are positions in the tree or, if frames continue each other, identities.
    """
    image, in_order = frame.leaf_image, not frame.settings.temporal
    counts = np.bincount(image.ravel(), minlength=1 << 16)
    known = {0}
    for place, leaf in enumerate(frame.leaves(), start=1):
        label = leaf.leaf or 0
        if in_order and label != place:
            yield frame.wrong(leaf.name, "leaf", f"{place}, its place among the leaves", leaf.leaf)
        if label in known and (label > 0 or leaf.size > 0):
            yield frame.wrong(leaf.name, "leaf", "a label of its own", leaf.leaf)
            continue
        known.add(label)
        pixels = int(counts[label]) if 0 < label < counts.size else 0
        if leaf.size != pixels:
            yield frame.wrong(leaf.name, "size", f"{pixels}, the pixels of its label", leaf.size)
    for label in sorted(set(np.flatnonzero(counts).tolist()) - known):
        file = f"{frame.stem}_{'surfaces' if frame.objects else 'labels'}.png"
        yield Finding(file, "", f"label {label}", "a leaf of the tree", f"{counts[label]} pixels of none")
    for name, each in frame.segments.items():
        if each.children:
            total = sum(frame.segments[child].size for child in each.children)
            if each.size != total:
                yield frame.wrong(name, "size", f"{total}, the sum of its children", each.size)
        yield from _labels_of(frame, each)
    yield from _check_objects(frame, in_order)


def _labels_of(frame: ExportedFrame, each: ExportedSegment) -> Iterator[Finding]:
    """Check a segment's label, leaf and object against each other."""
    by_object = bool(frame.objects) and frame.tree.level != "surfaces"
    expected = each.object if by_object else each.leaf
    if each.label != expected:
        yield frame.wrong(each.name, "label", expected, each.label)
    if not each.children:
        return
    for field, value in (("leaf", each.leaf), ("object", each.object)):
        if value is not None:
            yield frame.wrong(each.name, field, "None, it is no leaf", value)


def _check_objects(frame: ExportedFrame, in_order: bool) -> Iterator[Finding]:
    object_of = {name: number for number, names in frame.objects.items() for name in names}
    listed = [name for names in frame.objects.values() for name in names]
    leaves = [leaf.name for leaf in frame.leaves()]
    if frame.objects and sorted(listed) != sorted(leaves):
        yield frame.wrong("", "objects", f"each of the leaves {sorted(leaves)} once", sorted(listed))
    if in_order and list(frame.objects) != list(range(1, len(frame.objects) + 1)):
        yield frame.wrong("", "objects", "the numbers 1, 2, ...", list(frame.objects))
    label_of = np.zeros(1 << 16, dtype=np.uint16)
    for leaf in frame.leaves():
        if leaf.object != object_of.get(leaf.name):
            yield frame.wrong(leaf.name, "object", object_of.get(leaf.name), leaf.object)
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
