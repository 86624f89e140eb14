"""Objects from frame to frame: statistics of borders are filtered, so that merges do not flicker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.border_statistics import BorderStatistics, border_statistics
from nurbseg.segmentation.extended.merge import Contact, SceneObject, merged_objects
from nurbseg.segmentation.extended.smooth import smooth_borders
from nurbseg.segmentation.live.leaf import LiveLeaf
from nurbseg.segmentation.points.depth_grid import DepthGrid
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice

#: Share of a frame in what is remembered of a border.
_NEW_SHARE = 0.2
#: Merged surfaces stay so while their crease is less concave than this share over what is allowed, others
#: apart while it is more than this share under it.
_HYSTERESIS = 0.25
#: Borders whose smoothness is looked at again in one frame; new ones are all looked at.
_SMOOTH_AGAIN = 1
#: Frames for which a border that is not seen is remembered.
_REMEMBERED = 30

_Pair = tuple[int, int]


@dataclass(slots=True)
class _Border:
    """What is remembered of the border of two leaves."""

    samples: float
    touching: float
    concavity_sum: float
    smooth: bool | None = None
    merged: bool | None = None
    checked: int = 0
    seen: int = 0


class ObjectMemory:
    """Merges the leaves of frame after frame into objects."""

    def __init__(self) -> None:
        self._borders: dict[_Pair, _Border] = {}
        self._frame = 0

    @property
    def same_object(self) -> set[tuple[int, int]]:
        """Numbers of leaves, the smaller first, that met in the last frame and are one object."""
        return {
            pair for pair, border in self._borders.items() if border.merged and border.seen == self._frame
        }

    def merged(
        self,
        leaves: Sequence[LiveLeaf],
        on_grid: NDArray[np.int32],
        lattice: SurfaceLattice,
        grid: DepthGrid,
        config: SegmentationConfig,
    ) -> tuple[tuple[SceneObject, ...], tuple[Contact, ...]]:
        """Merge the leaves of a frame, with what is remembered of their borders.

        Parameters
        ----------
        leaves : sequence of LiveLeaf
            Of the labels 1, 2, ...
        on_grid : (h, w) int32
            Labels of the grid pixels.
        lattice : SurfaceLattice
            Of their surfaces.
        grid : DepthGrid
            The points.
        config : SegmentationConfig
            What is merged, and up to which concavity.

        Returns
        -------
        objects, contacts
            As those of `merge_surfaces`.
        """
        if not (config.extended.merge_crease or config.extended.merge_smooth):
            return (), ()
        self._frame += 1
        step = grid.step
        rays = replace(
            grid.rays,
            center=(grid.rays.center[0] / step, grid.rays.center[1] / step),
            scale=grid.rays.scale / step,
        )

        def evaluate(
            label: NDArray[np.int32], u: NDArray[np.float64], v: NDArray[np.float64]
        ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
            inverse_depth, along_u, along_v = lattice.slopes_at(label, u * step, v * step)
            return inverse_depth, along_u * step, along_v * step

        found = border_statistics(
            on_grid, (), rays, gap_per_m=config.extended.inverse_depth_gap, evaluate=evaluate
        )
        pairs = [self._pair(leaves, each) for each in found]
        for pair, each in zip(pairs, found, strict=True):
            self._remember(pair, each, step)
        known = [self._remembered(each, self._borders[pair]) for pair, each in zip(pairs, found, strict=True)]
        smooth: set[tuple[int, int]] = set()
        if config.extended.merge_smooth:
            smooth = self._smooth(known, pairs, on_grid, grid, config)
        biased = [
            self._biased(each, self._borders[pair], config) for pair, each in zip(pairs, known, strict=True)
        ]
        names = [leaf.node.name for leaf in leaves]
        objects, contacts = merged_objects(biased, smooth, on_grid, names, config)
        for pair, contact in zip(pairs, contacts, strict=True):
            self._borders[pair].merged = contact.merged
        forgotten = [
            pair for pair, border in self._borders.items() if self._frame - border.seen > _REMEMBERED
        ]
        for pair in forgotten:
            del self._borders[pair]
        return objects, contacts

    @staticmethod
    def _pair(leaves: Sequence[LiveLeaf], found: BorderStatistics) -> _Pair:
        first, second = leaves[found.first - 1].number, leaves[found.second - 1].number
        return (first, second) if first < second else (second, first)

    def _remember(self, pair: _Pair, found: BorderStatistics, step: int) -> None:
        # Samples count as those on every pixel, to be compared with the same limits.
        samples, touching = found.samples * step, found.touching * step
        concavity = found.concavity_sum * step
        border = self._borders.get(pair)
        if border is None:
            border = self._borders[pair] = _Border(samples, touching, concavity)
        else:
            border.samples += _NEW_SHARE * (samples - border.samples)
            border.touching += _NEW_SHARE * (touching - border.touching)
            border.concavity_sum += _NEW_SHARE * (concavity - border.concavity_sum)
        border.seen = self._frame

    @staticmethod
    def _remembered(found: BorderStatistics, border: _Border) -> BorderStatistics:
        return replace(
            found,
            samples=round(border.samples),
            touching=round(border.touching),
            concavity_sum=border.concavity_sum,
        )

    @staticmethod
    def _biased(known: BorderStatistics, border: _Border, config: SegmentationConfig) -> BorderStatistics:
        if border.merged is None:
            return known
        bias = _HYSTERESIS * config.extended.concavity_max * known.touching
        return replace(known, concavity_sum=known.concavity_sum + (-bias if border.merged else bias))

    def _smooth(
        self,
        known: Sequence[BorderStatistics],
        pairs: Sequence[_Pair],
        on_grid: NDArray[np.int32],
        grid: DepthGrid,
        config: SegmentationConfig,
    ) -> set[tuple[int, int]]:
        """Return which labels meet in a smooth border; asks again for some, the longest unasked first."""
        borders = [self._borders[pair] for pair in pairs]
        unasked = [n for n, border in enumerate(borders) if border.smooth is None]
        again = sorted(
            (n for n, border in enumerate(borders) if border.smooth is not None),
            key=lambda n: borders[n].checked,
        )
        asked = [*unasked, *again[:_SMOOTH_AGAIN]]
        answers = smooth_borders([known[n] for n in asked], on_grid, grid, config)
        for n, answer in zip(asked, answers, strict=True):
            borders[n].smooth = answer
            borders[n].checked = self._frame
        return {
            (each.first, each.second) for each, border in zip(known, borders, strict=True) if border.smooth
        }
