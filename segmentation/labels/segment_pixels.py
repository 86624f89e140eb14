"""Pixels in the order of labels, and segments with the pixels that are theirs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled
from nurbseg.segmentation.segments import Node, Segment


def by_label(labels: NDArray[np.integer], count: int) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Sort the places of an image by label.

    Parameters
    ----------
    labels : (N,) uint16 or int32
        0 to ``count - 1``.
    count : int
        Number of labels.

    Returns
    -------
    order : (N,) intp
        The places of label 0, of label 1, and so on, ascending within each.
    bounds : (count + 1,) int64
        Where those of each label begin in `order`, and its length.
    """
    order, bounds = np.empty(labels.size, dtype=np.intp), np.zeros(count + 1, dtype=np.int64)
    _sort_by_label(labels, order, bounds)
    return order, bounds


@compiled
def _sort_by_label(labels: NDArray[np.integer], order: NDArray[np.intp], bounds: NDArray[np.int64]) -> None:
    """Count labels, and put each place where those of its label are, run by run of equal labels."""
    starts, runs = np.empty(labels.size + 1, dtype=np.int64), 0
    for place in range(labels.size):
        if place == 0 or labels[place] != labels[place - 1]:
            starts[runs] = place
            runs += 1
    starts[runs] = labels.size
    for run in range(runs):
        bounds[labels[starts[run]] + 1] += starts[run + 1] - starts[run]
    for label in range(1, bounds.size):
        bounds[label] += bounds[label - 1]
    following = bounds.copy()
    for run in range(runs):
        place, size = starts[run], starts[run + 1] - starts[run]
        at = following[labels[place]]
        for n in range(size):
            order[at + n] = place + n
        following[labels[place]] += size


def finished_segments(
    nodes: list[Node], leaves: list[Node], labels: NDArray[np.uint16]
) -> tuple[Segment, ...]:
    """Give every node the pixels of the leaves below it.

    Parameters
    ----------
    nodes, leaves : list of Node
        Depth first.
    labels : (H, W) uint16
        Place of each pixel's leaf plus one; 0 where there is no point.

    Returns
    -------
    tuple of Segment
        In the order of the nodes.
    """
    order, bounds = by_label(labels.reshape(-1), len(leaves) + 1)
    label = {leaf.name: number for number, leaf in enumerate(leaves, start=1)}
    # Leaves come depth first, so those below a node stand side by side in the order of labels.
    reach: dict[str, tuple[int, int]] = {}
    for node in reversed(nodes):
        if node.children:
            first, second = (reach[child.name] for child in node.children)
            reach[node.name] = first[0], second[1]
        else:
            reach[node.name] = bounds[label[node.name]], bounds[label[node.name] + 1]
    return tuple(
        Segment(
            name=node.name,
            parent=node.name[:-1] if node.name else None,
            children=tuple(child.name for child in node.children),  # type: ignore[arg-type]
            pixels=order[slice(*reach[node.name])],
            fit=node.fit,
            ratio=node.ratio,
            stop=node.stop,
            cut=node.cut,
        )
        for node in nodes
    )


__all__ = ["by_label", "finished_segments"]
