"""Labels for every pixel of the image from a tree that was decided on a coarser grid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.cut import Cut
from nurbseg.segmentation.grid import PixelGrid
from nurbseg.segmentation.registration import PointMap


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """A kept split: leaves ``first`` to ``middle - 1`` are below part 0, ``middle`` to ``end - 1`` below 1.

    Parameters
    ----------
    first, middle, end : int
        Numbers of leaves in depth-first order.
    cut : Cut
        Says which part a vector belongs to.
    """

    first: int
    middle: int
    end: int
    cut: Cut


def settle(
    cloud: PointMap,
    grid: PixelGrid,
    leaves: Sequence[NDArray[np.intp]],
    splits: Sequence[Split],
    vectors_of: Callable[[NDArray[np.intp]], NDArray[np.float32]],
) -> NDArray[np.int32]:
    """Give every pixel that has a point to a leaf.

    A pixel whose nearest places on the grid (up to four, around it) belong to one leaf belongs there too.
    Where they disagree, the pixel's own vector decides, at the split that parted the leaves in question:
    the extension of that cut says which part it belongs to. The clean-up of small pieces is kept, since
    only leaves around the pixel are in question.

    Parameters
    ----------
    cloud : PointMap
        The frame.
    grid : PixelGrid
        The grid on which the tree was decided.
    leaves : sequence of (N,) intp
        Flat places of each leaf on the grid, in depth-first order.
    splits : sequence of Split
        The kept splits, a segment before its parts.
    vectors_of : callable
        Gives the (N, D) float32 feature vectors of some flat pixels of the image.

    Returns
    -------
    (H * W,) int32
        Number of each pixel's leaf; ``len(leaves)`` where there is no point.
    """
    height, width = grid.image_shape
    none = len(leaves)
    on_grid = np.full(grid.valid.size, none, dtype=np.int32)
    for number, places in enumerate(leaves):
        on_grid[places] = number
    if grid.step == 1:
        return on_grid
    labels = np.full(height * width, none, dtype=np.int32)
    pixels = np.flatnonzero(cloud.valid)
    if none == 1:
        labels[pixels] = 0
        return labels
    around = _around(on_grid.reshape(grid.shape), pixels, grid)
    around[around == none] = -1
    largest = around.max(axis=1)
    agreed = (largest >= 0) & ((around == largest[:, np.newaxis]) | (around < 0)).all(axis=1)
    labels[pixels[agreed]] = largest[agreed]
    undecided = pixels[~agreed]
    labels[undecided] = _decide(around[~agreed], vectors_of(undecided), none, splits)
    return labels


def _decide(
    candidates: NDArray[np.int32],
    vectors: NDArray[np.float32],
    leaf_count: int,
    splits: Sequence[Split],
) -> NDArray[np.int32]:
    """Walk pixels down the tree; a cut is asked only where both of its parts are in question.

    `candidates` (N, 4) holds leaves, -1 for none; a pixel without any is in question everywhere.
    """
    numbers = np.zeros(candidates.shape[0], dtype=np.int32)
    by_range = {(split.first, split.end): split for split in splits}
    stack = [(0, leaf_count, np.arange(candidates.shape[0]))]
    while stack:
        first, end, rows = stack.pop()
        if rows.size == 0:
            continue
        if end - first == 1:
            numbers[rows] = first
            continue
        split = by_range[first, end]
        near = candidates[rows]
        in_first = np.any((near >= first) & (near < split.middle), axis=1)
        second = np.any((near >= split.middle) & (near < end), axis=1)
        asked = in_first == second
        second[asked] = split.cut.classify(vectors[rows[asked]])
        stack.append((first, split.middle, rows[~second]))
        stack.append((split.middle, end, rows[second]))
    return numbers


def _around(on_grid: NDArray[np.int32], pixels: NDArray[np.intp], grid: PixelGrid) -> NDArray[np.int32]:
    """Return the leaves at the four places of the grid around each pixel, (N, 4)."""
    rows, columns = np.divmod(pixels, grid.image_shape[1])
    height, width = on_grid.shape
    top, left = rows // grid.step, columns // grid.step
    bottom = np.minimum((rows + grid.step - 1) // grid.step, height - 1)
    right = np.minimum((columns + grid.step - 1) // grid.step, width - 1)
    return np.stack(
        [on_grid[top, left], on_grid[top, right], on_grid[bottom, left], on_grid[bottom, right]], axis=1
    )


__all__ = ["Split", "settle"]
