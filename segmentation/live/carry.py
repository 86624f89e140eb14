"""The tree of the frame before, carried into a frame: its leaves at their present pixels, fitted anew."""

from dataclasses import replace
from itertools import accumulate

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.folding import remove_node
from nurbseg.segmentation.extended.grid_features import GridFeatures
from nurbseg.segmentation.extended.memory import LeafMemory, leaf_memory
from nurbseg.segmentation.extended.parts import chain_components, nodes_of
from nurbseg.segmentation.labels.regions import connected_components
from nurbseg.segmentation.labels.spreading import spread_labels
from nurbseg.segmentation.live.follow import VANISHED_SHARE
from nurbseg.segmentation.segments import Node, depth_first, leaf_ranges, leaves_below
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.vocabulary import Division

#: A part that something in front cuts off from a leaf is one of its own from so many times the smallest size
#: on, for edges of things would make many.
_CUT_OFF_FACTOR = 4.0
#: Why a segment that was divided without a cut has no surface.
NOT_CUT = "divided without a cut"

_Pixels = NDArray[np.intp]


def carry_tree(
    root: Node, carried: NDArray[np.int32], frame: int, features: GridFeatures, config: SegmentationConfig
) -> int | None:
    """Give the leaves of a tree their grid pixels in this frame, and fit them.

    Every connected component is a leaf: parts that are no longer connected become leaves of their own, below
    a gap, and so do points that no leaf explains, beside the leaf that surrounds them. Leaves that have
    vanished are removed. Segments above have the union of the pixels below them.

    Parameters
    ----------
    root : Node
        Of the tree, which is changed.
    carried : (h, w) int32
        Index of each grid pixel's leaf plus one; 0 where none explains the point.
    frame, features : int, GridFeatures
        The frame and its number.
    config : SegmentationConfig
        The smallest component, the gap in depth, and what fits are made of.

    Returns
    -------
    int or None
        How many leaves have appeared; None if nothing is left of the tree, which is not changed then.
    """
    leaves = leaves_below(root)
    numbers, labels_of = _components(carried, len(leaves), features, config)
    parts_of: dict[int, list[Node]] = {}
    fitted = features.fitter.of_labels(numbers, np.arange(labels_of.size))
    for part, label in zip(nodes_of(fitted, config), labels_of[1:].tolist(), strict=True):
        if part.grid_pixels.size:
            parts_of.setdefault(label, []).append(part)
    if not any(label <= len(leaves) for label in parts_of):
        return None
    vanished = []
    for label, leaf in enumerate(leaves, start=1):
        if label in parts_of:
            _renew_leaf(leaf, parts_of[label], frame)
        else:
            vanished.append(leaf)
    while vanished:
        sibling, parent = remove_node(root, vanished.pop())
        vanished = [parent if leaf is sibling else leaf for leaf in vanished]
    appeared = parts_of.get(len(leaves) + 1, [])
    for part in appeared:
        insert_beside(_around(root, part.grid_pixels, features), part)
    renew_unions(root)
    return len(appeared)


def _components(
    carried: NDArray[np.int32], count: int, features: GridFeatures, config: SegmentationConfig
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the number of each grid pixel's connected component, and the label of each number.

    The label is ``count + 1`` where no leaf explains the points. Small components go to their neighbors, so
    that a number may have no grid pixel.
    """
    grid, least = features.grid, features.grid_pixels_min(config)
    marked = np.where(grid.valid & (carried == 0), np.int32(count + 1), carried)
    found = connected_components(marked, features.adjacency, least, keep=count)
    sizes = np.bincount(found.numbers.reshape(-1), minlength=found.labels_of.size)
    largest = np.zeros(count + 2, dtype=np.int64)
    np.maximum.at(largest, found.labels_of, sizes)
    is_cut_off = (found.labels_of <= count) & (sizes < largest[found.labels_of])
    is_small = (sizes < VANISHED_SHARE * least) | (is_cut_off & (sizes < _CUT_OFF_FACTOR * least))
    numbers = np.where(is_small[found.numbers], 0, found.numbers)
    small = np.flatnonzero((numbers == 0) & grid.valid)
    if numbers.any():
        spread_labels(numbers, small, grid.inverse_depth, config.extended.inverse_depth_gap)
    return numbers, found.labels_of


def _renew_leaf(leaf: Node, parts: list[Node], frame: int) -> None:
    """Give a leaf the pixels and the fit of this frame; several parts become its children."""
    parts = sorted(parts, key=lambda part: -part.grid_pixels.size)
    parts[0].memory = leaf.memory
    for part in parts[1:]:
        part.memory = LeafMemory(frame, cut_from=leaf_memory(leaf))
    top = chain_components(leaf.name, parts, leaf.cuts_above)
    leaf.grid_pixels, leaf.fit, leaf.memory = top.grid_pixels, top.fit, top.memory
    leaf.children, leaf.division, leaf.stop = top.children, top.division, top.stop
    leaf.trial = leaf.measured = leaf.judged = None


def insert_beside(leaf: Node, part: Node) -> None:
    """Divide a leaf, without a cut, into itself and a part that has appeared."""
    name, depth = leaf.name, leaf.cuts_above
    rest = Node(f"{name}0", leaf.grid_pixels, leaf.fit, stop=leaf.stop, cuts_above=depth, memory=leaf.memory)
    part.name, part.cuts_above = f"{name}1", depth
    leaf.children, leaf.division = (rest, part), Division.APPEARED
    leaf.stop = leaf.trial = leaf.memory = None


def _around(root: Node, grid_pixels: _Pixels, features: GridFeatures) -> Node:
    """Return the leaf with the longest border to some grid pixels, or the largest if none touches them."""
    leaves = leaves_below(root)
    labels = np.zeros(features.grid.shape, dtype=np.int32)
    for label, leaf in enumerate(leaves, start=1):
        labels.reshape(-1)[leaf.grid_pixels] = label
    image = np.zeros(features.grid.shape, dtype=np.uint8)
    image.reshape(-1)[grid_pixels] = 1
    ring = cv2.dilate(image, np.ones((3, 3), dtype=np.uint8)) > image
    lengths = np.bincount(labels[ring], minlength=len(leaves) + 1)[1:]
    most = max(range(len(leaves)), key=lambda n: (lengths[n], leaves[n].grid_pixels.size))
    return leaves[most]


def renew_unions(root: Node) -> None:
    """Give segments the pixels of the leaves below, leaf by leaf; surfaces of other frames are dropped."""
    nodes = depth_first(root)
    ranges, leaves = leaf_ranges(nodes), [node for node in nodes if not node.children]
    # By label: where the pixels of a leaf begin.
    bounds = [0, *accumulate((leaf.grid_pixels.size for leaf in leaves), initial=0)]
    grid_pixels = np.concatenate([leaf.grid_pixels for leaf in leaves])
    pixels = np.concatenate([leaf.fit.pixels for leaf in leaves])
    for node in nodes:
        if not node.children:
            continue
        first, end = ranges[node.name]
        node.grid_pixels = grid_pixels[bounds[first] : bounds[end]]
        if node.division is not Division.CUT:
            reason = node.fit.reason or NOT_CUT
            node.fit = Fit(None, np.zeros(0), {}, reason, pixels[bounds[first] : bounds[end]])
            node.measured = None
            # The trial of a crease is that of the frame in which it was found.
            node.judged = node.judged if node.division is Division.CREASE else None
        elif node.measured is not None and node.fit.surface is not None:
            reason = f"measured in frame {node.measured}"
            node.fit = replace(node.fit, surface=None, residuals_m=np.zeros(0), reason=reason)
