"""Updates of the live tree in a frame, the worst first, within a budget."""

from collections.abc import Container, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.folding import BORDER_LEAST
from nurbseg.segmentation.extended.grid_features import GridFeatures, with_features_at
from nurbseg.segmentation.extended.parts import at_noise_floor, fit_segment, judge_split
from nurbseg.segmentation.extended.splitting import split_segment
from nurbseg.segmentation.live.editor import TreeEditor
from nurbseg.segmentation.live.leaf import Attempt, LeafPair, Misfit
from nurbseg.segmentation.live.renewal import TRIAL_FRAMES
from nurbseg.segmentation.points.grid import united
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, Trial, depth_first
from nurbseg.segmentation.vocabulary import StopReason

#: A leaf is tried again for a split if its mean square is this much larger than at the last trial.
_WORSE_FACTOR, _WORSE_BY = 1.5, 0.5
#: Grid pixels cut in one frame, unless one leaf has more.
_CUT_PIXELS = 2000
#: A leaf smaller than this share of the smallest size has vanished.
_VANISHED_SHARE = 0.25
#: Largest number of leaves that appear in one frame; the others wait.
_APPEARING_MOST = 6
#: Wear of a surface by one frame, in units of its relative misfit.
_WEAR = 0.05


@dataclass(frozen=True, slots=True)
class Budget:
    """How much of the tree is updated in one frame.

    Parameters
    ----------
    refits : int
        Leaves that are fitted again, the worst first.
    trials : int
        Leaves that are cut to try a split, the worst first; a large one counts as all.
    merges : int
        Pairs of leaves that are compared with one surface for both.
    coarser : int
        Pixels by which the grid step exceeds the usual one.
    """

    refits: int = 6
    trials: int = 3
    merges: int = 2
    coarser: int = 0


@dataclass(slots=True, eq=False)
class TreeUpdate:
    """An update of a tree in a frame, the worst first, within a budget.

    Parameters
    ----------
    editor : TreeEditor
        Of the tree, which is changed.
    cloud, features : PointMap, GridFeatures
        The frame; raw vectors are made of it where they are needed.
    measures : Misfit
        How well the surfaces of the leaves explain their labels.
    frame : int
        Number of the frame.
    budget : Budget
        How much is done.
    config : SegmentationConfig
        Thresholds and choices.
    """

    editor: TreeEditor
    cloud: PointMap
    features: GridFeatures
    measures: Misfit
    frame: int
    budget: Budget
    config: SegmentationConfig

    def __post_init__(self) -> None:
        """Fill in how well leaves were explained after their last fit or trial, where it is not known."""
        for number, leaf in self.editor.by_number.items():
            if np.isnan(leaf.level) and leaf.age <= 1:
                leaf.level = float(self.measures.mean_squared[number])
            if np.isnan(leaf.tried):
                leaf.tried = float(self.measures.mean_squared[number])

    def run(
        self,
        rejected: Sequence[Node],
        appeared: NDArray[np.int32],
        same_object: Container[LeafPair],
        compared: dict[LeafPair, int],
    ) -> None:
        """Update the tree: the worst leaves first, as far as the budget allows.

        Parameters
        ----------
        rejected : sequence of Node
            Segments whose split the ratio no longer keeps, by the surfaces of the frame before.
        appeared : (h, w) int32
            Numbers of components that no leaf explains; 0 elsewhere.
        same_object : container of LeafPair
            Adjacent leaves of one object.
        compared : dict of LeafPair to int
            In which frame two leaves were compared last; gets those of this frame.
        """
        self.collapse(rejected)
        self.add_appeared(appeared)
        self.remove_vanished()
        self.refit()
        self.split()
        self.merge_leaves(same_object, compared)

    def add_appeared(self, appeared: NDArray[np.int32]) -> None:
        """Add leaves for components that no leaf explains, each next to the one that surrounds it."""
        for piece in range(1, int(appeared.max()) + 1):
            mask = appeared == piece
            neighbor = self.editor.around(mask)
            if neighbor is None:
                continue
            if piece > _APPEARING_MOST:
                self.editor.labels[mask] = neighbor
                continue
            part = fit_segment(self.features, np.flatnonzero(mask), self.config)
            self.editor.insert(neighbor, part, self.frame)

    def remove_vanished(self) -> None:
        """Remove leaves that have become very small."""
        editor = self.editor
        sizes, least = editor.sizes(), _VANISHED_SHARE * self.features.grid_pixels_min(self.config)
        for number in [n for n in editor.by_number if sizes[n] < least]:
            if len(editor.by_number) < 2:
                return
            kept = editor.around(editor.labels == number)
            if kept is None or kept == number:
                kept = max((n for n in editor.by_number if n != number), key=lambda n: int(sizes[n]))
            editor.merge_leaves(number, kept)

    def refit(self) -> None:
        """Fit surfaces again: those that explain their leaves worst, or are oldest."""
        m = self.measures
        need = []
        for number, leaf in self.editor.by_number.items():
            if number >= m.mean_squared.size or m.counts[number] == 0:
                continue
            level = 1.0 if np.isnan(leaf.level) else leaf.level
            worse = (float(m.mean_squared[number]) - level) / (level + 0.5)
            need.append((worse + _WEAR * leaf.age + 20.0 * float(m.unreached[number]), number))
        for wear, number in sorted(need, reverse=True)[: self.budget.refits]:
            if wear <= 0:
                break
            leaf = self.editor.by_number[number]
            own = np.flatnonzero(self.editor.labels == number)
            part = fit_segment(self.features, own, self.config)
            if part.fit.surface is not None:
                leaf.refit(part)
                self.editor.report.refits += 1

    def split(self) -> None:
        """Try to split leaves that have become worse, the worst first."""
        m, editor = self.measures, self.editor
        self._forget_oldest()
        waiting = []
        for number, leaf in editor.by_number.items():
            square = float(m.mean_squared[number]) if number < m.mean_squared.size else 0.0
            if square > _WORSE_FACTOR * leaf.tried + _WORSE_BY and self._may_be_split(number):
                waiting.append((square * float(np.sqrt(m.counts[number])), number))
        waiting.sort(reverse=True)
        room = self.config.splits_max - editor.cuts
        cuts = counted = 0
        for rank, (_, number) in enumerate(waiting):
            full = cuts == self.budget.trials or (cuts and counted + int(m.counts[number]) > _CUT_PIXELS)
            if full or editor.report.splits >= room:
                editor.report.waiting = len(waiting) - rank if full else 0
                return
            if self._try(number):
                cuts, counted = cuts + 1, counted + int(m.counts[number])

    def _forget_oldest(self) -> None:
        """Forget the oldest attempt if it is out of date, so that its leaf is tried again."""
        attempts = [leaf for leaf in self.editor.by_number.values() if leaf.attempt is not None]
        oldest = max(attempts, key=lambda leaf: leaf.attempt_age, default=None)
        # One in each frame, so early that none gets older than the limit.
        if oldest is not None and oldest.attempt_age >= TRIAL_FRAMES - len(attempts):
            oldest.attempt, oldest.tried = None, 0.0

    def _may_be_split(self, number: int) -> bool:
        """Return whether size, depth and distance from the noise allow a split."""
        m, node = self.measures, self.editor.by_number[number].node
        if m.counts[number] <= 2.0 * self.features.grid_pixels_min(self.config):
            return False
        return node.cuts_above < self.config.depth_max and not at_noise_floor(node.fit, self.config)

    def collapse(self, rejected: Sequence[Node]) -> None:
        """Judge rejected splits again with fitted surfaces, and undo those that are not kept."""
        editor = self.editor
        for node in rejected:
            if not (node.children and editor.contains(node)):
                continue
            own = [np.flatnonzero(editor.labels == number) for number in editor.below(node)]
            own = [each for each in own if each.size]
            if not own:
                continue
            whole, trial = self._compare(own)
            if trial.kept or whole.fit.surface is None:
                node.trial, node.judged, node.age = trial, self.frame, 0
            else:
                self._refit_merged(editor.collapse(node), whole, trial)

    def merge_leaves(self, same_object: Container[LeafPair], compared: dict[LeafPair, int]) -> None:
        """Merge leaves of an object, in turn, if the ratio does not keep them apart."""
        editor, most = self.editor, self.budget.merges
        neighbors = editor.neighbors(self.features.adjacency, BORDER_LEAST) if most else []
        leaves_of = {pair: frozenset(editor.by_number[number] for number in pair) for pair in neighbors}
        wanted = [pair for pair, leaves in leaves_of.items() if leaves in same_object]
        for pair in sorted(wanted, key=lambda pair: (compared.get(leaves_of[pair], 0), pair))[:most]:
            compared[leaves_of[pair]] = self.frame
            own = [np.flatnonzero(editor.labels == number) for number in pair]
            whole, trial = self._compare(own, [editor.by_number[number].node for number in pair])
            if trial.kept or whole.fit.surface is None:
                continue
            kept, gone = pair if own[0].size >= own[1].size else (pair[1], pair[0])
            editor.merge_leaves(gone, kept)
            self._refit_merged(kept, whole, trial)
            return

    def _compare(
        self, grid_pixels: Sequence[NDArray[np.intp]], nodes: Sequence[Node] = ()
    ) -> tuple[Node, Trial]:
        """Compare one surface with nodes as they are and, if these are not better, with new fits."""
        config = self.config
        whole = fit_segment(self.features, united(grid_pixels), config)
        if nodes:
            sizes = [own.size for own in grid_pixels]
            values = [node.value(config) for node in nodes]
            trial = judge_split(whole.weighed(config), list(zip(values, sizes, strict=True)), config)
            if trial.kept:
                return whole, trial
        parts = [fit_segment(self.features, own, config).weighed(config) for own in grid_pixels]
        return whole, judge_split(whole.weighed(config), parts, config)

    def _refit_merged(self, number: int, whole: Node, trial: Trial) -> None:
        """Give a merged leaf its fit, and the trial that rejected its parts."""
        leaf = self.editor.by_number[number]
        leaf.refit(whole)
        # These parts were rejected; no cut of the whole was tried.
        leaf.tried = 0.0
        leaf.attempt = Attempt(StopReason.CRITERION, trial, self.frame)
        self.editor.report.merges += 1

    def _try(self, number: int) -> bool:
        """Try to split a leaf; return whether it was cut, which takes time."""
        leaf = self.editor.by_number[number]
        node = leaf.node
        self.editor.report.trials += 1
        leaf.tried = float(self.measures.mean_squared[number])
        own = np.flatnonzero(self.editor.labels == number)
        whole = fit_segment(self.features, own, self.config)
        leaf.refit(whole)
        leaf.attempt = None
        if whole.stop is not None or node.fit.surface is None or not node.value(self.config) > 0:
            return False
        features = with_features_at(self.cloud, self.features, node.grid_pixels, self.config)
        split_segment(features, node, self.config)
        if not node.children:
            leaf.attempt = Attempt(node.stop or StopReason.NO_CUT, node.trial, self.frame)
            return True
        self.editor.report.splits += 1
        node.measured = node.judged = self.frame
        node.age = 0
        below = depth_first(node)[1:]
        for each in below:
            each.judged = self.frame
        first, *others = sorted(
            (each for each in below if not each.children), key=lambda each: -each.grid_pixels.size
        )
        leaf.node, leaf.surface, leaf.tried = first, first.fit.surface, 0.0
        for each in others:
            self.editor.add_leaf(each)
        return True
