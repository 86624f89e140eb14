"""Editing of the live tree: leaves are added, removed and merged."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F32, I32, U16, compiled
from nurbseg.segmentation.extended.folding import remove_node
from nurbseg.segmentation.labels.regions import PixelAdjacency, borders
from nurbseg.segmentation.live.leaf import LiveLeaf
from nurbseg.segmentation.segments import Node, depth_first
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.vocabulary import Division

#: Why a segment that was divided without a cut has no surface.
NOT_CUT = "divided without a cut"


@dataclass(slots=True)
class UpdateReport:
    """What was done to the tree for a frame.

    Parameters
    ----------
    reset : str
        Why the frame was segmented from scratch; empty if the tree was continued.
    unexplained : float
        Share of the points that the moved surfaces did not explain.
    refits, trials, splits, appeared, merges, judged : int
        Numbers of surfaces fitted again, leaves tried for a split, splits made, leaves that came into view,
        merges of leaves, and splits judged again.
    oldest, oldest_trial : int
        Frames since the oldest value or ratio of a split was found, and since the oldest trial of a leaf.
    waiting : int
        Leaves that are to be tried in later frames.
    step : int
        Pixels from one grid pixel to the next.
    """

    reset: str = ""
    unexplained: float = 0.0
    refits: int = 0
    trials: int = 0
    splits: int = 0
    appeared: int = 0
    merges: int = 0
    judged: int = 0
    oldest: int = 0
    oldest_trial: int = 0
    waiting: int = 0
    step: int = 1


class TreeEditor:
    """Edits a tree; the working numbers of leaves are their labels so far, and further ones for new leaves.

    Parameters
    ----------
    root : Node
        Of the tree, which is changed.
    leaves : sequence of LiveLeaf
        Of the labels 1, 2, ...
    on_grid : (h, w) int32
        Labels on the grid.

    Attributes
    ----------
    by_number : dict of int to LiveLeaf
        The leaves.
    labels : (h, w) int32
        Working number of every grid pixel.
    report : UpdateReport
        What was done so far.
    """

    def __init__(self, root: Node, leaves: Sequence[LiveLeaf], on_grid: NDArray[np.int32]) -> None:
        self.by_number: dict[int, LiveLeaf] = dict(enumerate(leaves, start=1))
        self.labels = on_grid.copy()
        self.report = UpdateReport()
        self._root, self._before = root, on_grid
        self._merged_into: dict[int, int] = {}
        self._next = len(leaves) + 1

    def sizes(self) -> NDArray[np.int64]:
        """Return the number of grid pixels of each working number, that of 0 being 0."""
        sizes = np.bincount(self.labels.reshape(-1), minlength=self._next)
        sizes[0] = 0
        return sizes

    def neighbors(self, adjacency: PixelAdjacency, least: int) -> list[tuple[int, int]]:
        """Return pairs of leaves that are adjacent along so many grid pixels, the smaller number first."""
        flat = self.labels.reshape(-1)
        one, other = np.sort([flat[ends] for ends in borders(self.labels, adjacency)], axis=0)
        lengths = np.bincount(one * self._next + other)
        return [divmod(pair, self._next) for pair in np.flatnonzero(lengths >= least).tolist()]

    @property
    def cuts(self) -> int:
        """Number of cuts in the tree, which T_s limits."""
        return sum(node.division is Division.CUT for node in depth_first(self._root))

    def insert(self, neighbor: int, part: Node, frame: int) -> None:
        """Divide a leaf, without a cut, into itself and a part that came into view in a frame."""
        leaf = self.by_number[neighbor]
        node = leaf.node
        rest = Node(f"{node.name}0", node.grid_pixels, node.fit, cuts_above=node.cuts_above)
        new = Node(f"{node.name}1", part.grid_pixels, part.fit, cuts_above=node.cuts_above)
        node.children, node.division, node.judged = (rest, new), Division.APPEARED, frame
        node.fit, node.measured = Fit(None, np.zeros(0), {}, NOT_CUT, np.zeros(0, dtype=np.intp)), None
        node.stop = node.trial = node.cut = None
        leaf.node = rest
        self.add_leaf(new)
        self.report.appeared += 1

    def add_leaf(self, node: Node) -> None:
        """Make a leaf of a node, of which no split was tried yet, with the next working number."""
        self.by_number[self._next] = LiveLeaf(node, tried=0.0)
        self.labels.ravel()[node.grid_pixels] = self._next
        self._next += 1

    def below(self, node: Node) -> list[int]:
        """Return the working numbers of the leaves below a node."""
        below = {id(each) for each in depth_first(node)}
        return [number for number, leaf in self.by_number.items() if id(leaf.node) in below]

    def collapse(self, node: Node) -> int:
        """Merge all leaves below a node; return the working number, that of the largest of them."""
        numbers, sizes = self.below(node), self.sizes()
        kept = max(numbers, key=lambda number: int(sizes[number]))
        for number in numbers:
            if number != kept:
                self._hand_over(number, kept)
        node.children, node.division, node.cut = (), None, None
        self.by_number[kept].node = node
        return kept

    def contains(self, node: Node) -> bool:
        """Return whether a node is in the tree."""
        return any(each is node for each in depth_first(self._root))

    def merge_leaves(self, gone: int, kept: int) -> None:
        """Give the grid pixels of one leaf to another, and remove it from the tree."""
        sibling, parent = remove_node(self._root, self._hand_over(gone, kept).node)
        for each in self.by_number.values():
            if each.node is sibling:
                each.node = parent

    def _hand_over(self, gone: int, kept: int) -> LiveLeaf:
        """Give the grid pixels of one working number to another; return the leaf that has none now."""
        self.labels[self.labels == gone] = kept
        self._merged_into[gone] = kept
        return self.by_number.pop(gone)

    def around(self, mask: NDArray[np.bool_]) -> int | None:
        """Return the leaf with the longest border to some grid pixels, or the largest, if there is one."""
        kernel = np.ones((3, 3), dtype=np.uint8)
        ring = (cv2.dilate(mask.view(np.uint8), kernel) > 0) & ~mask
        counts = np.bincount(self.labels[ring], minlength=1)
        counts[0] = 0
        # If nothing touches it, the largest leaf.
        number = int(counts.argmax() if counts.any() else self.sizes().argmax())
        return number if number in self.by_number else None

    def finished(self) -> tuple[list[LiveLeaf], NDArray[np.uint16]]:
        """Return the leaves in the order of the tree, and the label from now on of each working number."""
        by_node = {id(leaf.node): (number, leaf) for number, leaf in self.by_number.items()}
        final = np.zeros(self._next, dtype=np.uint16)
        leaves: list[LiveLeaf] = []
        for node in depth_first(self._root):
            if not node.children:
                number, leaf = by_node[id(node)]
                leaves.append(leaf)
                final[number] = len(leaves)
        for gone, kept in reversed(self._merged_into.items()):
            final[gone] = final[kept]
        return leaves, final

    def relabelled(
        self,
        labels: NDArray[np.uint16],
        final: NDArray[np.uint16],
        inverse_depth: NDArray[np.float32],
        step: int,
    ) -> NDArray[np.uint16]:
        """Apply the update to a label image (H, W), given inverse depths, 1/m (0: no point, so no label)."""
        return _relabelled(labels, inverse_depth, self._before, self.labels, final, step)


@compiled
def _relabelled(labels: U16, inverse_depth: F32, before: I32, on_grid: I32, final: U16, step: int) -> U16:
    """Look up final labels; pixels that have the label of their grid pixel change with it."""
    height, width = labels.shape
    relabelled = np.empty((height, width), dtype=np.uint16)
    known, number = np.empty(width, dtype=np.int32), np.empty(width, dtype=np.int32)
    on_row = np.arange(width) // step
    for r in range(height):
        own, depths, now = labels[r], inverse_depth[r], relabelled[r]
        if r % step == 0:
            row_before, row_now = before[r // step], on_grid[r // step]
            for c in range(width):
                known[c], number[c] = row_before[on_row[c]], row_now[on_row[c]]
        for c in range(width):
            # Pixels of another label keep it; unlabelled ones take this one.
            label = np.int32(own[c])
            found = final[number[c] if label == known[c] else label]
            now[c] = found if depths[c] > 0 else 0
    return relabelled
