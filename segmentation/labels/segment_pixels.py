"""Pixels sorted by label, and finished segments with their pixels."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import I64, U16, Intp, compiled
from nurbseg.segmentation.labels.boxes import bounding_boxes
from nurbseg.segmentation.points.grid import Window
from nurbseg.segmentation.segments import Node, Segment, history, leaf_ranges
from nurbseg.segmentation.surfaces.fit import Fit


def by_label(labels: NDArray[np.integer], count: int) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Sort the pixels of an image by label.

    Parameters
    ----------
    labels : (N,) uint16 or int32
        0 to ``count - 1``.
    count : int
        Number of labels.

    Returns
    -------
    order : (N,) intp
        The pixels of label 0, of label 1, and so on, ascending within each.
    bounds : (count + 1,) int64
        Where those of each label begin in `order`, and its length.
    """
    order, bounds = np.empty(labels.size, dtype=np.intp), np.zeros(count + 1, dtype=np.int64)
    _sort_by_label(labels.astype(np.uint16, copy=False), order, bounds)
    return order, bounds


@compiled
def _sort_by_label(labels: U16, order: Intp, bounds: I64) -> None:
    """Sort by counting, run by run of equal labels."""
    starts, runs = np.empty(labels.size + 1, dtype=np.int64), 0
    for pixel in range(labels.size):
        if pixel == 0 or labels[pixel] != labels[pixel - 1]:
            starts[runs] = pixel
            runs += 1
    starts[runs] = labels.size
    for run in range(runs):
        bounds[labels[starts[run]] + 1] += starts[run + 1] - starts[run]
    for label in range(1, bounds.size):
        bounds[label] += bounds[label - 1]
    following = bounds.copy()
    for run in range(runs):
        pixel, size = starts[run], starts[run + 1] - starts[run]
        at = np.uint32(following[labels[pixel]])
        for n in range(size):
            order[at + n] = pixel + n
        following[labels[pixel]] += size


def finished_segments(nodes: list[Node], labels: NDArray[np.uint16]) -> tuple[Segment, ...]:
    """Make segments of nodes: with all pixels below, inside the windows of their surfaces.

    Parameters
    ----------
    nodes : list of Node
        Depth first.
    labels : (H, W) uint16
        Index of each pixel's leaf plus one; 0 where there is no point.

    Returns
    -------
    tuple of Segment
        In the order of the nodes.
    """
    ranges = leaf_ranges(nodes)
    count = ranges[nodes[0].name][1]
    order, bounds = by_label(labels.reshape(-1), count)
    boxes = bounding_boxes(labels, count)
    return tuple(
        Segment(
            name=node.name,
            parent=node.name[:-1] if node.name else None,
            children=tuple(child.name for child in node.children),  # type: ignore[arg-type]
            pixels=order[bounds[first] : bounds[end]],
            fit=_widened(node.fit, boxes[first:end]),
            **history(node),
        )
        for node, (first, end) in ((node, ranges[node.name]) for node in nodes)
    )


def _widened(fit: Fit, boxes: list[Window]) -> Fit:
    """Extend the window of a fit's surface to boxes of pixels: borders move after surfaces are fitted."""
    if fit.surface is None:
        return fit
    # An empty box changes nothing.
    top, left, bottom, right = zip(fit.surface.window, *boxes, strict=True)
    window = min(top), min(left), max(bottom), max(right)
    if window == fit.surface.window:
        return fit
    return replace(fit, surface=replace(fit.surface, window=window))
