"""Objects from frame to frame: evidence is filtered over time, so that merges do not flicker."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.border_statistics import BorderStatistics, border_statistics
from nurbseg.segmentation.extended.evidence import DIGITS, ITEMS, evidence
from nurbseg.segmentation.extended.merge import Contact, SceneObject, WeighedBorders, merged_objects
from nurbseg.segmentation.extended.surface_statistics import surface_statistics
from nurbseg.segmentation.extended.things import Join, join_objects
from nurbseg.segmentation.live.leaf import LiveLeaf, number_pair
from nurbseg.segmentation.points.depth_grid import DepthGrid
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice

#: Weight of a new frame in the filtered evidence.
_NEW_SHARE = 0.2
#: Added to the log odds of surfaces merged in the frame before, subtracted from those of others.
_HYSTERESIS = 0.5
#: Frames for which a border that does not occur is remembered.
_REMEMBERED = 30

_Pair = tuple[int, int]


@dataclass(slots=True, eq=False)
class _Border:
    """The filtered border of two leaves: samples, touching ones, and terms of the evidence."""

    measured: NDArray[np.float64]
    merged: bool | None = None
    seen: int = 0


class ObjectMemory:
    """Merges the leaves of frame after frame into objects."""

    def __init__(self) -> None:
        self._borders: dict[_Pair, _Border] = {}
        self._joined: set[_Pair] = set()
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
        """Merge the leaves of a frame by the filtered evidence along their borders.

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
            Whether to merge, the least log odds, noise and gap.

        Returns
        -------
        objects, contacts
            As those of `merge_surfaces`; evidence has one more term, ``kept``, the hysteresis.
        """
        if not config.extended.merge_surfaces:
            return (), ()
        self._frame += 1
        found = _borders_on_grid(on_grid, lattice, grid, config)
        noise_per_m = config.extended.inverse_depth_noise
        items = evidence(found, surface_statistics(on_grid, len(leaves), grid), noise_per_m)
        pairs = [number_pair(leaves[label - 1] for label in labels) for labels in found.labels.tolist()]
        measured = np.column_stack([found.samples, found.touching, items])
        borders = [self._remembered(pair, each) for pair, each in zip(pairs, measured, strict=True)]

        names = [leaf.node.name for leaf in leaves]
        objects, contacts = merged_objects(_weighed(found, borders), on_grid, names, config)
        for border, contact in zip(borders, contacts, strict=True):
            border.merged = contact.merged
        self._borders = {
            pair: each for pair, each in self._borders.items() if self._frame - each.seen <= _REMEMBERED
        }
        return objects, contacts

    def joined(
        self,
        objects: Sequence[SceneObject],
        contacts: Sequence[Contact],
        leaves: Sequence[LiveLeaf],
        on_grid: NDArray[np.int32],
        grid: DepthGrid,
        color: NDArray[np.uint8],
        config: SegmentationConfig,
    ) -> tuple[tuple[SceneObject, ...], tuple[Join, ...]]:
        """Join objects that others separate in the image, with easier limits if they were joined before.

        Parameters are as those of `merged` and `join_objects`.
        """
        number = {leaf.node.name: leaf.number for leaf in leaves}
        name_of = {leaf.number: leaf.node.name for leaf in leaves}
        kept = {frozenset(name_of.get(each, "") for each in pair) for pair in self._joined}
        objects, joins = join_objects(
            objects, contacts, on_grid, list(number), grid, color, config, kept=kept
        )
        self._joined = {(number[each.first], number[each.second]) for each in joins}
        return objects, joins

    def _remembered(self, pair: _Pair, measured: NDArray[np.float64]) -> _Border:
        """Return a border updated with what was measured now."""
        border = self._borders.get(pair)
        if border is None:
            border = self._borders[pair] = _Border(measured)
        else:
            border.measured = border.measured + _NEW_SHARE * (measured - border.measured)
        border.seen = self._frame
        return border


def _borders_on_grid(
    on_grid: NDArray[np.int32], lattice: SurfaceLattice, grid: DepthGrid, config: SegmentationConfig
) -> BorderStatistics:
    """Measure borders on the grid, with linearly interpolated surfaces."""
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

    gap_per_m = config.extended.inverse_depth_gap
    found = border_statistics(on_grid, evaluate, rays, gap_per_m=gap_per_m)
    # Scaled to samples on every pixel.
    sums = (found.samples, found.touching, found.concavity, found.concavity_square, found.apart)
    return BorderStatistics(found.labels, *(step * each for each in sums))


def _weighed(found: BorderStatistics, borders: Sequence[_Border]) -> WeighedBorders:
    """Return filtered borders with hysteresis."""
    measured = np.array([border.measured for border in borders]).reshape(-1, 2 + len(ITEMS))
    kept = [0.0 if border.merged is None else 2.0 * border.merged - 1.0 for border in borders]
    samples, touching = np.rint(measured[:, :2]).astype(np.int64).T
    items = np.column_stack([np.round(measured[:, 2:], DIGITS), _HYSTERESIS * np.array(kept)])
    return WeighedBorders(found.labels, samples, touching, items, (*ITEMS, "kept"))
