"""Objects from frame to frame: what was merged stays so while the evidence is undecided."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.memory import LeafMemory, LeafPair
from nurbseg.segmentation.objects.merge import Objects, measure, merged_objects
from nurbseg.segmentation.points.grid import DepthGrid
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

#: Added to the log odds of surfaces merged in the frame before, subtracted from those of others. With more,
#: merges outlast the evidence of a frame alone; with none, labels flicker.
_HYSTERESIS = 1.0
#: A change of the log odds by more than this is a change of the scene: what was before counts nothing.
_JUMP = 2.0
#: Frames for which a border that does not occur is remembered.
_REMEMBERED = 30


@dataclass(slots=True, eq=False)
class _Border:
    """The border of two leaves: its log odds when it was last seen, and the hysteresis."""

    log_odds: float
    kept: float = 0.0
    seen: int = 0


class ObjectMemory:
    """Merges the leaves of frame after frame into objects."""

    def __init__(self) -> None:
        self._borders: dict[LeafPair, _Border] = {}
        self._frame = 0

    def merged(
        self,
        leaves: Sequence[LeafMemory],
        names: Sequence[str],
        labels: NDArray[np.int32],
        table: SurfaceTable,
        grid: DepthGrid,
        config: SegmentationConfig,
    ) -> Objects:
        """Merge the leaves of a frame by the evidence along their borders.

        Parameters
        ----------
        leaves : sequence of LeafMemory
            Of the labels 1, 2, ..., each the same object in all frames.
        names : sequence of str
            Of the same leaves.
        labels : (H, W) int32
            Of the pixels.
        table : SurfaceTable
            Surfaces of the labels.
        grid : DepthGrid
            The points.
        config : SegmentationConfig
            Whether to merge, the least log odds, noise and gap.

        Returns
        -------
        Objects
            As those of `merge_surfaces`; evidence has one more term, ``kept``, the hysteresis.
        """
        if not config.extended.merge_surfaces:
            return Objects()
        self._frame += 1
        found = measure(labels, grid, len(leaves), table, config)
        log_odds = found.items.sum(axis=1).tolist()
        pairs = [
            frozenset((leaves[one - 1], leaves[other - 1])) for one, other in found.borders.labels.tolist()
        ]
        new = map(_Border, log_odds)
        borders = [self._borders.setdefault(*each) for each in zip(pairs, new, strict=True)]
        for border, now in zip(borders, log_odds, strict=True):
            border.kept = 0.0 if abs(now - border.log_odds) > _JUMP else border.kept
            border.log_odds, border.seen = now, self._frame
        found.items[:, -1] = [border.kept for border in borders]
        merged = merged_objects(found, labels, names, config)
        object_of = {name: each for each in merged.objects for name in each.leaves}
        for border, (one, other) in zip(borders, found.borders.labels.tolist(), strict=True):
            together = object_of[names[one - 1]] is object_of[names[other - 1]]
            border.kept = _HYSTERESIS if together else -_HYSTERESIS
        self._borders = {
            pair: border for pair, border in self._borders.items() if self._frame - border.seen <= _REMEMBERED
        }
        return merged
