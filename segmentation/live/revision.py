"""What of the live tree is revised in a frame: the worst first, as far as the budget goes."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.features import raw_vectors
from nurbseg.segmentation.extended.splitting import Scene, best_split, children_of, measured, prepare
from nurbseg.segmentation.labels.lookup import looked_up
from nurbseg.segmentation.labels.regions import Joints
from nurbseg.segmentation.live.leaf import LiveLeaf, Misfit, misfit
from nurbseg.segmentation.live.structure import Growth, Revised
from nurbseg.segmentation.points.normals import facet_normals
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, StopReason, depth_first
from nurbseg.segmentation.surfaces.inverse_depth import DepthGrid
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice
from nurbseg.segmentation.surfaces.surface import NurbsSurface

#: What a surface leaves beyond noise: mean square, and share beyond three deviations.
_SQUARE_MOST, _FAR_MOST = 2.2, 0.05
#: A leaf is tried again for a split when its mean square is this much more than at the last trial.
_WORSE_FACTOR, _WORSE_BY = 1.5, 0.5
#: Two leaves become one where so much less noise than there is explains both.
_FOLD_NOISE = 0.9
#: The mean square that one surface may leave on either, as a factor on what its own leaves, and on top of it.
_FOLD_WORSE, _FOLD_NOISE_SHARE = 1.1, 0.05
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
        self._frame = 0
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
        budget : Budget
            How much is done.
        config : SegmentationConfig
            Thresholds and choices.

        Returns
        -------
        Revised
            The leaves in their new order, and their labels.
        """
        self._frame += 1
        growth = Growth(root, leaves, on_grid, self.leaf)
        work = _Revision(growth, cloud, grid, joined, measures, config)
        work.take_in(appeared)
        work.take_out()
        work.refit(budget.refits)
        work.split(budget.trials)
        work.fold(budget.folds, together, self._asked, self._frame)
        self._asked = {pair: at for pair, at in self._asked.items() if self._frame - at < _FORGOTTEN}
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
    ) -> None:
        self._growth, self._cloud, self._config = growth, cloud, config
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
            self._growth.insert(host, measured(self._scene, np.flatnonzero(mask), self._config))
            self._growth.done.splits += 1

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
            places, fit, stop = measured(self._scene, own, self._config)
            if fit.surface is None:
                continue
            leaf.node.places, leaf.node.fit = places, fit
            leaf.surface, leaf.age, leaf.level = fit.surface, 0, float("nan")
            if stop is not None:
                leaf.node.stop = stop
            elif leaf.node.stop in (None, StopReason.NOISE):
                leaf.node.stop = StopReason.CRITERION
            self._growth.done.refits += 1

    def split(self, most: int) -> None:
        """Try leaves for a split that have become worse, the worst first."""
        m, config = self._measures, self._config
        waiting = []
        for number, leaf in self._growth.by_number.items():
            if number >= m.square.size or m.places[number] <= 2.0 * self._places_min:
                continue
            square, far = float(m.square[number]), float(m.far[number])
            explained = config.noise_floor > 0 and square < _SQUARE_MOST and far < _FAR_MOST
            if not explained and square > _WORSE_FACTOR * leaf.tried + _WORSE_BY:
                waiting.append((square * float(np.sqrt(m.places[number])), number))
        waiting.sort(reverse=True)
        cuts = places = 0
        for rank, (_, number) in enumerate(waiting):
            if cuts == most or (cuts and places + int(m.places[number]) > _CUT_PLACES):
                self._growth.done.waiting = len(waiting) - rank
                break
            if self._try(number):
                cuts, places = cuts + 1, places + int(m.places[number])

    def fold(
        self,
        most: int,
        together: Container[tuple[int, int]],
        asked: dict[tuple[int, int], int],
        frame: int,
    ) -> None:
        """Let a leaf take in another of its object that its surface explains; the longest unasked first."""
        config, growth = self._config, self._growth
        if not (config.noise_floor > 0 and most):
            return
        neighbors = growth.neighbors(self._scene.joined, _MEETING_LEAST)
        quieter = replace(config, noise_per_m=_FOLD_NOISE * config.noise_per_m)

        def pair_of(pair: tuple[int, int]) -> tuple[int, int]:
            one, two = (growth.by_number[n].number for n in pair)
            return (one, two) if one < two else (two, one)

        candidates = [pair for pair in neighbors if pair_of(pair) in together]
        pairs = sorted((asked.get(pair_of(pair), 0), pair) for pair in candidates)
        for _, pair in pairs[:most]:
            asked[pair_of(pair)] = frame
            sizes = growth.sizes()
            kept, gone = pair if sizes[pair[0]] >= sizes[pair[1]] else (pair[1], pair[0])
            places = np.flatnonzero((growth.labels == kept) | (growth.labels == gone))
            _, fit, stop = measured(self._scene, places, quieter)
            if stop is None or fit.surface is None or not self._is_as_good(pair, fit.surface):
                continue
            growth.absorb(gone, kept)
            leaf = growth.by_number[kept]
            leaf.node.places, leaf.node.fit, leaf.node.stop = places, fit, stop
            leaf.surface, leaf.age, leaf.level, leaf.tried = fit.surface, 0, float("nan"), float("nan")
            growth.done.folds += 1
            return

    def _is_as_good(self, pair: tuple[int, int], surface: NurbsSurface) -> bool:
        """Say whether a surface explains each of two leaves as well as their own surfaces do."""
        grid, own = self._scene.grid, self._measures.square
        if max(pair) >= own.size:
            return False
        labels = np.zeros(grid.valid.shape, dtype=np.int32)
        for label, number in enumerate(pair, start=1):
            labels[self._growth.labels == number] = label
        both = misfit(
            labels, SurfaceLattice([surface, surface], grid.step), grid, self._config.noise_per_m, 2
        )
        limits = [min(_FOLD_WORSE * own[number] + _FOLD_NOISE_SHARE, _SQUARE_MOST) for number in pair]
        return all(both.square[n] < limit and both.far[n] < _FAR_MOST for n, limit in enumerate(limits, 1))

    def _try(self, number: int) -> bool:
        """Try a leaf for a split; say whether it was cut for that, which is what takes time."""
        leaf = self._growth.by_number[number]
        node = leaf.node
        node.places = np.flatnonzero(self._growth.labels == number)
        self._growth.done.trials += 1
        leaf.tried = float(self._measures.square[number])
        _, node.fit, stop = measured(self._scene, node.places, self._config)
        leaf.surface, leaf.age, leaf.level = node.fit.surface, 0, float("nan")
        if stop is not None or node.fit.surface is None or not node.value(self._config) > 0:
            return False
        scene = scene_of(self._cloud, self._scene, node.places, self._config)
        sides, cut = best_split(scene, node, self._config, thin_from=_MANY_PLACES)
        if cut is None:
            return True
        self._growth.done.splits += 1
        node.children = children_of(node, sides)
        node.cut = cut if all(sides) else None
        node.stop = None
        parts = [each for each in depth_first(node) if not each.children]
        parts.sort(key=lambda each: -each.places.size)
        for part in parts:
            part.stop = part.stop or StopReason.CRITERION
        leaf.node, leaf.surface, leaf.tried = parts[0], parts[0].fit.surface, 0.0
        for part in parts[1:]:
            self._growth.labels.ravel()[part.places] = self._growth.adopt(part)
        return True


def scene_of(cloud: PointMap, scene: Scene, places: NDArray[np.intp], config: SegmentationConfig) -> Scene:
    """Return a scene whose raw vectors are known at some places only, those that are to be split.

    Parameters
    ----------
    cloud, scene : PointMap, Scene
        The frame.
    places : (N,) intp
        Flat places of the grid, ascending.
    config : SegmentationConfig
        Windows and weights.
    """
    if not config.normalize_nodes:
        return prepare(cloud, config)
    grid = scene.grid
    raw = np.zeros((grid.valid.size, 9 if config.normal_weight > 0 else 6), dtype=np.float32)
    raw[places, :6] = raw_vectors(cloud, grid.points.pixels(places))
    if config.normal_weight > 0:
        half = max(1, round(0.5 * config.normal_window_px * grid.unit_px / grid.step - 0.5))
        rows, columns, (top, left, bottom, right) = grid.points.locate(places)
        # Windows for normals look at what is around the segment too.
        top, left = max(0, top - 2 * half), max(0, left - 2 * half)
        bottom, right = bottom + 2 * half, right + 2 * half
        shifted = replace(
            grid.rays,
            center=(grid.rays.center[0] - left * grid.step, grid.rays.center[1] - top * grid.step),
        )
        normals = facet_normals(
            np.ascontiguousarray(grid.per_m[top:bottom, left:right]),
            np.ascontiguousarray(grid.valid[top:bottom, left:right]),
            shifted,
            step=grid.step,
            window=2 * half + 1,
            noise_per_m=config.noise_per_m,
        )
        raw[places, 6:] = normals[rows - top, columns - left]
    return replace(scene, raw=raw)


__all__ = ["Budget", "Reviser"]
