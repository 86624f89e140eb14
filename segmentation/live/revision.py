"""What of the live tree is revised in a frame: the worst first, as far as the budget goes."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.scene import Scene, scene_of
from nurbseg.segmentation.extended.splitting import Part, best_split, children_of, hopeless, measured
from nurbseg.segmentation.labels.lookup import looked_up
from nurbseg.segmentation.labels.regions import Joints
from nurbseg.segmentation.live.leaf import Attempt, LiveLeaf, Misfit
from nurbseg.segmentation.live.renewal import TRIAL_FRAMES
from nurbseg.segmentation.live.structure import Growth, Revised
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Division, Node, StopReason, Trial, depth_first
from nurbseg.segmentation.surfaces.inverse_depth import DepthGrid
from nurbseg.segmentation.surfaces.metrics import acceptance_ratio, metric_value

#: A leaf is tried again for a split when its mean square is this much more than at the last trial.
_WORSE_FACTOR, _WORSE_BY = 1.5, 0.5
#: Places of the grid along which two leaves that are held against one surface meet.
_MEETING_LEAST = 4
#: Places cut in one frame, unless one leaf has more; leaves with as many are cut at a quarter of them.
_CUT_PLACES, _MANY_PLACES = 2000, 3000
#: A leaf with fewer places than this share of the smallest is gone.
_GONE_SHARE = 0.25
#: Things that appear in one frame, at most; the others wait.
_APPEARING_MOST = 6
#: Frames after which a pair of leaves is asked as if for the first time.
_FORGOTTEN = 1000
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
        Leaves that are cut to try a split, the worst first; a large one counts as all.
    folds : int
        Pairs of leaves that are held against one surface for both.
    decimation : int or None
        Pixels from one place of the grid to the next; None for what the configuration says.
    """

    refits: int = 6
    trials: int = 3
    folds: int = 2
    decimation: int | None = None


class Reviser:
    """Revises a tree frame after frame; it remembers whose turn it is."""

    def __init__(self) -> None:
        self._numbers = count(1)
        self._asked: dict[tuple[int, int], int] = {}
        self._turn = 0
        self._final = np.zeros(1, dtype=np.uint16)

    def leaf(self, node: Node) -> LiveLeaf:
        """Make a leaf of a node, with a number of its own."""
        return LiveLeaf(node, next(self._numbers))

    def renumbered(self, labels: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return labels from before the last revision as they are now; 0 for those that are gone."""
        return looked_up(self._final, labels)

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
        together: Container[tuple[int, int]],
        rejected: Sequence[Node],
        frame: int,
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
        together : container of (int, int)
            Numbers of leaves, the smaller first, that meet and are one object.
        rejected : sequence of Node
            Segments whose split the ratio keeps no longer, and the trial that told so.
        frame : int
            Number of the frame.
        budget : Budget
            How much is done.
        config : SegmentationConfig
            Thresholds and choices.

        Returns
        -------
        Revised
            The leaves in their new order, and their labels.
        """
        self._turn += 1
        growth = Growth(root, leaves, on_grid, self.leaf)
        work = _Revision(growth, cloud, grid, joined, measures, config, self._turn, frame)
        work.undo(rejected)
        work.take_in(appeared)
        work.take_out()
        work.refit(budget.refits)
        work.split(budget.trials)
        work.fold(budget.folds, together, self._asked)
        self._asked = {pair: at for pair, at in self._asked.items() if self._turn - at < _FORGOTTEN}
        done = growth.finished()
        self._final = done.final
        return done


class _Revision:
    """One revision under way."""

    def __init__(
        self,
        growth: Growth,
        cloud: PointMap,
        grid: DepthGrid,
        joined: Joints,
        measures: Misfit,
        config: SegmentationConfig,
        turn: int,
        frame: int,
    ) -> None:
        self._growth, self._cloud, self._config = growth, cloud, config
        self._turn, self._frame = turn, frame
        self._scene = Scene(grid, joined, np.zeros((0, 0), dtype=np.float32), None)
        self._measures = measures
        self._places_min = config.piece_pixels_min * grid.points.pixel_share
        for number, leaf in growth.by_number.items():
            if np.isnan(leaf.level) and leaf.age <= 1:
                leaf.level = float(measures.square[number])
            if np.isnan(leaf.tried):
                leaf.tried = float(measures.square[number])

    def take_in(self, appeared: NDArray[np.int32]) -> None:
        """Make leaves of what no leaf explains, each beside the one that surrounds it."""
        for piece in range(1, int(appeared.max()) + 1):
            mask = appeared == piece
            host = self._growth.around(mask)
            if host is None:
                continue
            if piece > _APPEARING_MOST:
                self._growth.labels[mask] = host
                continue
            self._growth.insert(host, measured(self._scene, np.flatnonzero(mask), self._config), self._frame)

    def take_out(self) -> None:
        """Take leaves out of which next to nothing is left."""
        growth = self._growth
        sizes = growth.sizes()
        for number in [n for n in growth.by_number if sizes[n] < _GONE_SHARE * self._places_min]:
            if len(growth.by_number) < 2:
                return
            heir = growth.around(growth.labels == number)
            if heir is None or heir == number:
                heir = max((n for n in growth.by_number if n != number), key=lambda n: int(sizes[n]))
            growth.absorb(number, heir)

    def refit(self, most: int) -> None:
        """Fit the surfaces anew that explain their leaves worst, or are the oldest."""
        m = self._measures
        need = []
        for number, leaf in self._growth.by_number.items():
            if number >= m.square.size or m.places[number] == 0:
                continue
            level = 1.0 if np.isnan(leaf.level) else leaf.level
            worse = (float(m.square[number]) - level) / (level + 0.5)
            need.append((worse + _WEAR * leaf.age + 20.0 * float(m.unreached[number]), number))
        for wear, number in sorted(need, reverse=True)[:most]:
            if wear <= 0:
                break
            leaf = self._growth.by_number[number]
            own = np.flatnonzero(self._growth.labels == number)
            places, fit, _ = measured(self._scene, own, self._config)
            if fit.surface is None:
                continue
            leaf.node.places, leaf.node.fit = places, fit
            leaf.surface, leaf.age, leaf.level = fit.surface, 0, float("nan")
            self._growth.done.refits += 1

    def split(self, most: int) -> None:
        """Try leaves for a split that have become worse, the worst first."""
        m, growth = self._measures, self._growth
        self._forget_oldest()
        waiting = []
        for number, leaf in growth.by_number.items():
            square = float(m.square[number]) if number < m.square.size else 0.0
            if square > _WORSE_FACTOR * leaf.tried + _WORSE_BY and self._may_be_split(number):
                waiting.append((square * float(np.sqrt(m.places[number])), number))
        waiting.sort(reverse=True)
        room = self._config.splits_max - growth.cuts
        cuts = places = 0
        for rank, (_, number) in enumerate(waiting):
            full = cuts == most or (cuts and places + int(m.places[number]) > _CUT_PLACES)
            if full or growth.done.splits >= room:
                growth.done.waiting = len(waiting) - rank if full else 0
                return
            if self._try(number):
                cuts, places = cuts + 1, places + int(m.places[number])

    def _forget_oldest(self) -> None:
        """Let the oldest attempt count no more, if it is too old; its leaf is tried again."""
        attempts = [leaf for leaf in self._growth.by_number.values() if leaf.attempt is not None]
        oldest = max(attempts, key=lambda leaf: leaf.attempt_age, default=None)
        # One in each frame, so early that none gets older than the limit.
        if oldest is not None and oldest.attempt_age >= TRIAL_FRAMES - len(attempts):
            oldest.attempt, oldest.tried = None, 0.0

    def _may_be_split(self, number: int) -> bool:
        """Say whether neither its size nor its depth, nor how near it is to the noise, forbids a split."""
        m, node = self._measures, self._growth.by_number[number].node
        if m.places[number] <= 2.0 * self._places_min or hopeless(node.fit, self._config):
            return False
        return node.cuts_above < self._config.depth_max

    def undo(self, rejected: Sequence[Node]) -> None:
        """Judge splits again with surfaces fitted anew; make one leaf of each that is not kept."""
        growth = self._growth
        for node in rejected:
            if not (node.children and growth.holds(node)):
                continue
            own = [np.flatnonzero(growth.labels == number) for number in growth.below(node)]
            own = [places for places in own if places.size]
            if not own:
                continue
            whole = measured(self._scene, np.sort(np.concatenate(own), kind="stable"), self._config)
            trial = self._trial(whole, own)
            if trial.kept or whole[1].surface is None:
                node.trial, node.judged, node.age = trial, self._frame, 0
            else:
                self._fold_into(growth.undo(node), whole, Attempt(StopReason.CRITERION, trial, self._frame))

    def fold(
        self,
        most: int,
        together: Container[tuple[int, int]],
        asked: dict[tuple[int, int], int],
    ) -> None:
        """Let a leaf take in another of its object where the ratio keeps no two; in turn."""
        growth = self._growth

        def pair_of(pair: tuple[int, int]) -> tuple[int, int]:
            one, two = (growth.by_number[n].number for n in pair)
            return (one, two) if one < two else (two, one)

        neighbors = growth.neighbors(self._scene.joined, _MEETING_LEAST) if most else []
        candidates = [pair for pair in neighbors if pair_of(pair) in together]
        pairs = sorted((asked.get(pair_of(pair), 0), pair) for pair in candidates)
        for _, pair in pairs[:most]:
            asked[pair_of(pair)] = self._turn
            own = [np.flatnonzero(growth.labels == number) for number in pair]
            both = measured(self._scene, np.sort(np.concatenate(own), kind="stable"), self._config)
            trial = self._against(both, own, [growth.by_number[number] for number in pair])
            if trial is None or trial.kept or both[1].surface is None:
                continue
            kept, gone = pair if own[0].size >= own[1].size else (pair[1], pair[0])
            growth.absorb(gone, kept)
            self._fold_into(kept, both, Attempt(StopReason.CRITERION, trial, self._frame))
            return

    def _against(
        self, both: Part, own: Sequence[NDArray[np.intp]], leaves: Sequence[LiveLeaf]
    ) -> Trial | None:
        """Hold one surface for two leaves against one for each; None where they are better as they are."""
        config = self._config
        whole = metric_value(both[1].values, config.metric, both[1].floor), both[0].size
        as_they_are = [
            (leaf.node.value(config), places.size) for leaf, places in zip(leaves, own, strict=True)
        ]
        if acceptance_ratio(config.metric, whole, *as_they_are) < config.ratio_max:
            return None
        return self._trial(both, own)

    def _trial(self, whole: Part, parts: Sequence[NDArray[np.intp]]) -> Trial:
        """Hold a surface for some places against one fitted to each part of them (eq. 5)."""
        config = self._config
        fits = [whole[1], *(measured(self._scene, places, config)[1] for places in parts)]
        first, *others = (
            (metric_value(fit.values, config.metric, fit.floor), fit.pixels.size) for fit in fits
        )
        kept = acceptance_ratio(config.metric, first, *others) < config.ratio_max
        return Trial(config.metric, *first, tuple(others), kept)

    def _fold_into(self, number: int, part: Part, attempt: Attempt) -> None:
        """Give a leaf that has taken in others its fit, and the trial that told so."""
        leaf = self._growth.by_number[number]
        leaf.node.places, leaf.node.fit, _ = part
        leaf.surface, leaf.age, leaf.level, leaf.tried = part[1].surface, 0, float("nan"), float("nan")
        leaf.attempt = attempt
        self._growth.done.folds += 1

    def _try(self, number: int) -> bool:
        """Try a leaf for a split; say whether it was cut for that, which is what takes time."""
        leaf = self._growth.by_number[number]
        node = leaf.node
        self._growth.done.trials += 1
        leaf.tried = float(self._measures.square[number])
        own = np.flatnonzero(self._growth.labels == number)
        node.places, node.fit, stop = measured(self._scene, own, self._config)
        leaf.surface, leaf.age, leaf.level = node.fit.surface, 0, float("nan")
        leaf.attempt = None
        if stop is not None or node.fit.surface is None or not node.value(self._config) > 0:
            return False
        scene = scene_of(self._cloud, self._scene, node.places, self._config)
        sides, cut = best_split(scene, node, self._config, thin_from=_MANY_PLACES)
        if cut is None:
            leaf.attempt = Attempt(node.stop or StopReason.NO_CUT, node.trial, self._frame)
            return True
        self._growth.done.splits += 1
        node.children = children_of(node, sides)
        node.division, node.cut, node.stop = Division.CUT, cut if all(sides) else None, None
        node.measured = node.judged = self._frame
        node.age = 0
        below = depth_first(node)[1:]
        for each in below:
            each.judged = self._frame
        parts = sorted((each for each in below if not each.children), key=lambda each: -each.places.size)
        leaf.node, leaf.surface, leaf.tried = parts[0], parts[0].fit.surface, 0.0
        for part in parts[1:]:
            self._growth.labels.ravel()[part.places] = self._growth.adopt(part)
        return True


__all__ = ["Budget", "Reviser"]
