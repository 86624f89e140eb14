"""The live tree revised: leaves fitted anew, tried for splits, folded, taken in and taken out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import count

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.inverse_depth import DepthGrid
from nurbseg.segmentation.live_leaf import LiveLeaf, Misfit
from nurbseg.segmentation.metrics import acceptance_ratio
from nurbseg.segmentation.pieces import Joints
from nurbseg.segmentation.registration import PointMap
from nurbseg.segmentation.segments import Node, StopReason, depth_first
from nurbseg.segmentation.splitting import Part, Scene, best_split, children_of, measured, prepare

#: What a surface leaves beyond noise: mean square, and share beyond three deviations.
_SQUARE_MOST, _FAR_MOST = 2.2, 0.05
#: A leaf is tried again for a split when its mean square is this much more than at the last trial.
_WORSE_FACTOR, _WORSE_BY = 1.5, 0.5
#: A split is undone where less noise than there is explains both parts, or where its ratio is so much over T.
_FOLD_NOISE, _FOLD_RATIO = 0.9, 1.1
#: Frames between two looks at one leaf for what its surface does not explain, and of which a split is kept.
_PATIENCE = 10
#: A leaf with fewer places than this share of the smallest is gone.
_GONE_SHARE = 0.25
#: Things that appear in one frame, at most; the others wait.
_APPEARING_MOST = 6
#: Wear of a surface by one frame, in units of its relative misfit.
_WEAR = 0.05


@dataclass(frozen=True, slots=True)
class Budget:
    """How much of the tree is revised in one frame.

    Parameters
    ----------
    refits : int
        Leaves that are fitted anew, the worst first.
    trials : int
        Leaves that are tried for a split, the worst first.
    folds : int
        Splits that are held against one surface for both parts.
    """

    refits: int = 6
    trials: int = 1
    folds: int = 1


@dataclass(slots=True, eq=False)
class Revised:
    """What came of a revision.

    Parameters
    ----------
    leaves : list of LiveLeaf
        Of the labels 1, 2, ... from now on.
    before, on_grid : (h, w) int32
        Labels on the grid before it, and after it by their working numbers.
    final : (numbers,) uint16
        Label from now on of each working number.
    """

    leaves: list[LiveLeaf]
    before: NDArray[np.int32]
    on_grid: NDArray[np.int32]
    final: NDArray[np.uint16] = field(default_factory=lambda: np.zeros(1, dtype=np.uint16))
    refits: int = 0
    trials: int = 0
    splits: int = 0
    folds: int = 0
    waiting: int = 0

    def relabelled(self, labels: NDArray[np.uint16], step: int) -> NDArray[np.uint16]:
        """Return a label image as it is after the revision, (H, W) uint16."""
        height, width = labels.shape
        relabelled: NDArray[np.uint16] = self.final[labels]
        rows, columns = np.nonzero(self.on_grid != self.before)
        for down in range(step):
            for across in range(step):
                r, c = rows * step + down, columns * step + across
                inside = (r < height) & (c < width)
                r, c, at = r[inside], c[inside], (rows[inside], columns[inside])
                # Neighbours across a border keep what they have; what had no label takes this one.
                own = labels[r, c] == self.before[at]
                relabelled[r[own], c[own]] = self.final[self.on_grid[at][own]]
        return relabelled


class Reviser:
    """Revises a tree frame after frame; it remembers whose turn it is."""

    def __init__(self) -> None:
        self._numbers = count(1)
        self._fold_next = 0
        self._final = np.zeros(1, dtype=np.uint16)

    def leaf(self, node: Node) -> LiveLeaf:
        """Make a leaf of a node, with a number of its own."""
        return LiveLeaf(node, next(self._numbers))

    def renumbered(self, labels: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return labels from before the last revision as they are now; 0 for those that are gone."""
        known: NDArray[np.uint16] = self._final[np.minimum(labels, self._final.size - 1)]
        return known

    def revise(
        self,
        cloud: PointMap,
        grid: DepthGrid,
        joined: Joints,
        on_grid: NDArray[np.int32],
        appeared: NDArray[np.int32],
        root: Node,
        leaves: Sequence[LiveLeaf],
        measures: Misfit,
        budget: Budget,
        config: SegmentationConfig,
    ) -> Revised:
        """Revise a tree, the worst first and as far as the budget goes.

        Parameters
        ----------
        cloud, grid, joined : PointMap, DepthGrid, Joints
            The frame.
        on_grid : (h, w) int32
            Labels on the grid, 1 to the number of leaves; 0 for none.
        appeared : (h, w) int32
            Numbers of pieces that no leaf explains; 0 elsewhere.
        root : Node
            Of the tree, which is changed.
        leaves : sequence of LiveLeaf
            Of the labels.
        measures : Misfit
            How well their surfaces explain them.
        budget : Budget
            How much is done.
        config : SegmentationConfig
            Thresholds and choices.

        Returns
        -------
        Revised
            The leaves in their new order, and their labels.
        """
        work = _Work(self, cloud, grid, joined, on_grid, root, leaves, measures, config)
        work.take_in(appeared)
        work.take_out()
        work.refit(budget.refits)
        work.split(budget.trials)
        self._fold_next = work.fold(budget.folds, self._fold_next)
        done = work.finished()
        self._final = done.final
        return done


class _Work:
    """One revision under way; leaves go by working numbers, their labels so far and then further ones."""

    def __init__(
        self,
        reviser: Reviser,
        cloud: PointMap,
        grid: DepthGrid,
        joined: Joints,
        on_grid: NDArray[np.int32],
        root: Node,
        leaves: Sequence[LiveLeaf],
        measures: Misfit,
        config: SegmentationConfig,
    ) -> None:
        self._reviser, self._cloud, self._config, self._root = reviser, cloud, config, root
        self._scene = Scene(grid, joined, np.zeros((0, 0), dtype=np.float32), None)
        self._measures = measures
        self._by_number: dict[int, LiveLeaf] = dict(enumerate(leaves, start=1))
        self._instead: dict[int, int] = {}
        self._next = len(leaves) + 1
        self._done = Revised([], on_grid, on_grid.copy())
        self._labels = self._done.on_grid
        self._places_min = config.piece_pixels_min * grid.points.pixel_share
        for number, leaf in self._by_number.items():
            if np.isnan(leaf.level) and leaf.age <= 1:
                leaf.level = float(measures.square[number])
            if np.isnan(leaf.tried):
                leaf.tried = float(measures.square[number])

    def take_in(self, appeared: NDArray[np.int32]) -> None:
        """Make leaves of what no leaf explains, each beside the one that surrounds it."""
        for piece in range(1, int(appeared.max()) + 1):
            mask = appeared == piece
            host = self._around(mask)
            if host is None:
                continue
            if piece > _APPEARING_MOST:
                self._labels[mask] = host
                continue
            self._insert(host, measured(self._scene, np.flatnonzero(mask), self._config))
            self._done.splits += 1

    def take_out(self) -> None:
        """Take leaves out of which next to nothing is left."""
        sizes = np.bincount(self._labels.ravel(), minlength=self._next)
        for number in [n for n in self._by_number if sizes[n] < _GONE_SHARE * self._places_min]:
            if len(self._by_number) < 2:
                return
            mask = self._labels == number
            heir = self._around(mask)
            gone = self._by_number.pop(number)
            if heir is None or heir == number:
                heir = int(np.argmax([sizes[n] for n in self._by_number]))
                heir = list(self._by_number)[heir]
            self._labels[mask] = heir
            self._instead[number] = heir
            self._remove(gone.node)

    def refit(self, most: int) -> None:
        """Fit the surfaces anew that explain their leaves worst, or are the oldest."""
        m = self._measures
        need = []
        for number, leaf in self._by_number.items():
            if number >= m.square.size or m.places[number] == 0:
                continue
            level = 1.0 if np.isnan(leaf.level) else leaf.level
            worse = (float(m.square[number]) - level) / (level + 0.5)
            need.append((worse + _WEAR * leaf.age + 20.0 * float(m.unreached[number]), number))
        for wear, number in sorted(need, reverse=True)[:most]:
            if wear <= 0:
                break
            leaf = self._by_number[number]
            places, fit, stop = measured(self._scene, np.flatnonzero(self._labels == number), self._config)
            if fit.surface is None:
                continue
            leaf.node.places, leaf.node.fit = places, fit
            leaf.surface, leaf.age, leaf.level = fit.surface, 0, float("nan")
            if stop is not None:
                leaf.node.stop = stop
            elif leaf.node.stop in (None, StopReason.NOISE):
                leaf.node.stop = StopReason.CRITERION
            self._done.refits += 1

    def split(self, most: int) -> None:
        """Try leaves for a split that have become worse, the worst first."""
        m, config = self._measures, self._config
        waiting = []
        for number, leaf in self._by_number.items():
            if number >= m.square.size or m.places[number] <= 2.0 * self._places_min:
                continue
            square, far = float(m.square[number]), float(m.far[number])
            explained = config.noise_stop and square < _SQUARE_MOST and far < _FAR_MOST
            if not explained and square > _WORSE_FACTOR * leaf.tried + _WORSE_BY:
                waiting.append((square * float(np.sqrt(m.places[number])), number))
        waiting.sort(reverse=True)
        self._done.waiting = max(0, len(waiting) - most)
        if most and waiting:
            scene = prepare(self._cloud, config)
            for _, number in waiting[:most]:
                self._try(scene, number)
        elif most:
            self._try_unexplained()

    def fold(self, most: int, start: int) -> int:
        """Undo splits that one surface explains; return whose turn it is next."""
        config = self._config
        number_of = {id(leaf.node): number for number, leaf in self._by_number.items()}
        parents = [
            node
            for node in depth_first(self._root)
            if node.children and all(id(child) in number_of for child in node.children)
        ]
        for turn in range(min(most, len(parents))):
            parent = parents[(start + turn) % len(parents)]
            first, second = (number_of[id(child)] for child in parent.children)
            leaves = self._by_number[first], self._by_number[second]
            if not config.noise_stop or not self._adjacent(first, second):
                continue
            places = np.flatnonzero((self._labels == first) | (self._labels == second))
            quieter = replace(config, noise_per_m=_FOLD_NOISE * config.noise_per_m)
            _, fit, stop = measured(self._scene, places, quieter)
            if fit.surface is None:
                continue
            values = [(leaf.node.value(config), max(1, leaf.node.places.size)) for leaf in leaves]
            ratio = acceptance_ratio(
                config.metric, (fit.values.get(config.metric, 0.0), places.size), *values
            )
            if stop is None and not ratio > _FOLD_RATIO * config.ratio_max:
                continue
            kept, gone = (
                (first, second)
                if leaves[0].node.places.size >= leaves[1].node.places.size
                else (
                    second,
                    first,
                )
            )
            leaf = self._by_number[kept]
            parent.children, parent.cut, parent.stop = (), None, stop or StopReason.CRITERION
            parent.places, parent.fit, parent.ratio = places, fit, None
            leaf.node, leaf.surface, leaf.age = parent, fit.surface, 0
            leaf.level = leaf.tried = float("nan")
            self._labels[self._labels == gone] = kept
            del self._by_number[gone]
            self._instead[gone] = kept
            self._done.folds += 1
        return start + most

    def finished(self) -> Revised:
        """Give the leaves labels in the order of the tree, and end."""
        by_node = {id(leaf.node): (number, leaf) for number, leaf in self._by_number.items()}
        final = np.zeros(self._next, dtype=np.uint16)
        for node in depth_first(self._root):
            if node.children:
                continue
            number, leaf = by_node[id(node)]
            self._done.leaves.append(leaf)
            final[number] = len(self._done.leaves)
        for gone in self._instead:
            heir = gone
            while heir in self._instead:
                heir = self._instead[heir]
            final[gone] = final[heir]
        self._done.final = final
        return self._done

    def _try(self, scene: Scene, number: int) -> None:
        leaf = self._by_number[number]
        node = leaf.node
        node.places = np.flatnonzero(self._labels == number)
        self._done.trials += 1
        leaf.tried = float(self._measures.square[number])
        _, node.fit, stop = measured(scene, node.places, self._config)
        leaf.surface, leaf.age, leaf.level = node.fit.surface, 0, float("nan")
        if stop is not None or node.fit.surface is None or not node.value(self._config) > 0:
            return
        sides, cut = best_split(scene, node, self._config)
        if cut is None:
            return
        self._done.splits += 1
        node.children = children_of(node, sides)
        node.cut = cut if all(sides) else None
        node.stop = None
        parts = [each for each in depth_first(node) if not each.children]
        parts.sort(key=lambda each: -each.places.size)
        for part in parts:
            part.stop = part.stop or StopReason.CRITERION
        leaf.node, leaf.surface, leaf.tried = parts[0], parts[0].fit.surface, float("nan")
        for part in parts[1:]:
            self._labels.ravel()[part.places] = self._adopt(part)

    def _try_unexplained(self) -> None:
        """Set the largest patch apart that its leaf's surface does not explain but one of its own does."""
        m = self._measures
        unexplained = ((m.deviations > 3.0) & m.inner).view(np.uint8)
        far = cv2.morphologyEx(unexplained, cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8))
        patches, image, stats, _ = cv2.connectedComponentsWithStats(far, connectivity=4)
        if patches < 2:
            return
        for patch in np.argsort(-stats[1:, cv2.CC_STAT_AREA])[:4] + 1:
            if stats[patch, cv2.CC_STAT_AREA] < self._places_min:
                return
            mask = image == patch
            number = int(np.bincount(self._labels[mask]).argmax())
            leaf = self._by_number.get(number)
            if leaf is None or leaf.patience > 0:
                continue
            leaf.patience = _PATIENCE
            mask &= self._labels == number
            places = np.flatnonzero(mask)
            if places.size < self._places_min:
                continue
            self._done.trials += 1
            part = measured(self._scene, places, self._config)
            if part[2] is StopReason.NOISE:
                self._insert(number, part)
                self._done.splits += 1
            return

    def _insert(self, host: int, part: Part) -> None:
        """Split a leaf into itself and a part that is no longer its own."""
        leaf = self._by_number[host]
        node = leaf.node
        places, fit, stop = part
        depth = node.cuts_above + 1
        rest = Node(f"{node.name}0", node.places, node.fit, stop=node.stop, cuts_above=depth)
        new = Node(f"{node.name}1", places, fit, stop=stop or StopReason.CRITERION, cuts_above=depth)
        node.children, node.stop, node.cut, node.ratio = (rest, new), None, None, None
        leaf.node = rest
        self._labels.ravel()[places] = self._adopt(new)

    def _adopt(self, node: Node) -> int:
        number = self._next
        self._next += 1
        self._by_number[number] = self._reviser.leaf(node)
        return number

    def _around(self, mask: NDArray[np.bool_]) -> int | None:
        """Return the leaf that surrounds some places, if there is one."""
        kernel = np.ones((3, 3), dtype=np.uint8)
        ring = (cv2.dilate(mask.view(np.uint8), kernel) > 0) & ~mask
        labels = self._labels[ring]
        counts = np.bincount(labels[labels > 0], minlength=2)
        number = int(counts.argmax())
        if counts[number] == 0:
            # Nothing touches it: whatever is largest.
            sizes = np.bincount(self._labels.ravel(), minlength=2)
            sizes[0] = 0
            number = int(sizes.argmax())
        return number if number in self._by_number else None

    def _adjacent(self, first: int, second: int) -> bool:
        one, two = self._labels == first, self._labels == second
        near = cv2.dilate(one.view(np.uint8), np.ones((3, 3), dtype=np.uint8)) > 0
        return int(np.count_nonzero(near & two)) >= 4

    def _remove(self, gone: Node) -> None:
        """Let the other part of a split take the place of the whole."""
        for node in depth_first(self._root):
            if node.children and gone in node.children:
                (kept,) = (child for child in node.children if child is not gone)
                holder = next((leaf for leaf in self._by_number.values() if leaf.node is kept), None)
                node.places, node.fit, node.stop = kept.places, kept.fit, kept.stop
                node.ratio, node.cut, node.children = kept.ratio, kept.cut, kept.children
                if holder is not None:
                    holder.node = node
                _rename(node.children, node.name)
                return


def _rename(children: Iterable[Node], above: str) -> None:
    stack = [(child, f"{above}{place}") for place, child in enumerate(children)]
    while stack:
        node, name = stack.pop()
        node.name = name
        node.cuts_above = min(node.cuts_above, len(name))
        stack.extend((child, f"{name}{place}") for place, child in enumerate(node.children))


__all__ = ["Budget", "Revised", "Reviser"]
