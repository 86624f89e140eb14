"""Labels of every pixel from those on a coarser grid: by the cuts of a tree, or by depth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F32, I32, Bool, compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.ncut import Cut
from nurbseg.segmentation.labels.spreading import spread_in_place
from nurbseg.segmentation.points.grid import PixelGrid
from nurbseg.segmentation.points.registration import PointMap

_LEAVES_MAX = np.iinfo(np.uint16).max - 1


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


def upsample_labels(
    cloud: PointMap,
    grid: PixelGrid,
    leaves: Sequence[NDArray[np.intp]],
    splits: Sequence[Split],
    vectors_of: Callable[[NDArray[np.intp]], NDArray[np.float32]],
) -> NDArray[np.uint16]:
    """Give every pixel that has a point to a leaf.

    A pixel whose four surrounding grid pixels belong to one leaf takes that leaf. Elsewhere the cuts that
    separate these leaves classify the pixel's own vector. Only the leaves around it are candidates, so that
    small components that were removed do not come back.

    Parameters
    ----------
    cloud : PointMap
        The frame.
    grid : PixelGrid
        The grid on which the tree was decided.
    leaves : sequence of (N,) intp
        Flat indices of each leaf's grid pixels, in depth-first order.
    splits : sequence of Split
        The kept splits, a segment before its parts.
    vectors_of : callable
        Returns the (N, D) float32 feature vectors of some flat pixels of the image.

    Returns
    -------
    (H * W,) uint16
        Number of each pixel's leaf; ``len(leaves)`` where there is no point.

    Raises
    ------
    ValueError
        If there are more leaves than labels of 16 bits.
    """
    none = len(leaves)
    if none > _LEAVES_MAX:
        raise ValueError(f"leaves: expected at most {_LEAVES_MAX}, got {none}")
    on_grid = np.full(grid.valid.size, none, dtype=np.uint16)
    for number, grid_pixels in enumerate(leaves):
        on_grid[grid_pixels] = number
    if grid.step == 1:
        return on_grid
    labels = np.full(grid.image_shape, none, dtype=np.uint16)
    if none == 1:
        labels[cloud.valid] = 0
        return labels.reshape(-1)

    corners = _corners(on_grid.reshape(grid.shape))
    greatest = np.where(corners == none, np.int32(-1), corners).max(axis=0)
    agreed = (corners.min(axis=0) == greatest) | ((corners == greatest) | (corners == none)).all(axis=0)
    agreed &= greatest >= 0
    cells = _enlarged(np.where(agreed, greatest, none).astype(np.uint16), grid)
    np.copyto(labels, cells, where=cloud.valid)
    grid_pixels = np.flatnonzero(grid.valid)
    labels.reshape(-1)[grid.pixels(grid_pixels)] = on_grid[grid_pixels]

    undecided = np.flatnonzero((labels == none) & cloud.valid)
    rows, columns = np.divmod(undecided, grid.image_shape[1])
    candidates = corners[:, rows // grid.step, columns // grid.step]
    labels.reshape(-1)[undecided] = _decide(candidates, vectors_of(undecided), none, splits)
    return labels.reshape(-1)


def _corners(on_grid: NDArray[np.uint16]) -> NDArray[np.int32]:
    """Return the leaves at the corners of each cell, (4, h, w); the last row and column are repeated."""
    padded = np.pad(on_grid.astype(np.int32), ((0, 1), (0, 1)), mode="edge")
    return np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]])


def _enlarged(cells: NDArray[np.uint16], grid: PixelGrid) -> NDArray[np.uint16]:
    height, width = grid.image_shape
    tall = np.repeat(cells, grid.step, axis=0)[:height]
    return np.repeat(tall, grid.step, axis=1)[:, :width]


def _decide(
    candidates: NDArray[np.int32],
    vectors: NDArray[np.float32],
    leaf_count: int,
    splits: Sequence[Split],
) -> NDArray[np.uint16]:
    """Classify pixels down the tree, by the cuts both of whose parts hold candidates.

    `candidates` (4, N) holds leaves, `leaf_count` for none; without any, all leaves are candidates.
    """
    numbers = np.zeros(candidates.shape[1], dtype=np.uint16)
    by_range = {(split.first, split.end): split for split in splits}
    stack = [(0, leaf_count, np.arange(candidates.shape[1]))]
    while stack:
        first, end, rows = stack.pop()
        if rows.size == 0:
            continue
        if end - first == 1:
            numbers[rows] = first
            continue
        split = by_range[first, end]
        near = candidates[:, rows]
        in_first = np.any((near >= first) & (near < split.middle), axis=0)
        second = np.any((near >= split.middle) & (near < end), axis=0)
        asked = in_first == second
        second[asked] = split.cut.classify(vectors[rows[asked]])
        stack.append((first, split.middle, rows[~second]))
        stack.append((split.middle, end, rows[second]))
    return numbers


def upsample_by_depth(
    on_grid: NDArray[np.int32],
    grid_inverse_depth: NDArray[np.float32],
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    config: SegmentationConfig,
) -> NDArray[np.int32]:
    """Give every pixel that has a point a label, from labels on every few rows and columns.

    Parameters
    ----------
    on_grid : (h, w) int32
        Labels on the grid, 0 for none.
    grid_inverse_depth : (h, w) float32
        Inverse depth on the grid, 1/m.
    inverse_depth, valid : (H, W) float32 and bool
        Inverse depth of every pixel, 1/m, and where there is a point.
    config : SegmentationConfig
        The grid's step and the gap in depth.

    Returns
    -------
    (H, W) int32
        The label of the grid pixel at or before the pixel, or, across a gap in depth, that of the neighbour
        nearest in inverse depth. 0 only where there is no point.
    """
    labels = np.empty(valid.shape, dtype=np.int32)
    open_pixels = np.empty(valid.shape, dtype=np.bool_)
    _take_over(
        np.ascontiguousarray(on_grid),
        np.ascontiguousarray(grid_inverse_depth),
        np.ascontiguousarray(inverse_depth),
        np.ascontiguousarray(valid),
        config.decimation,
        np.float32(config.extended.inverse_depth_gap),
        labels,
        open_pixels,
    )
    spread_in_place(labels, np.flatnonzero(open_pixels), inverse_depth, config.extended.inverse_depth_gap)
    return labels


@compiled
def _take_over(
    on_grid: I32,
    grid_inverse_depth: F32,
    inverse_depth: F32,
    valid: Bool,
    step: int,
    gap_per_m: np.float32,
    labels: I32,
    open_pixels: Bool,
) -> None:
    """Give pixels the label of their grid pixel unless a gap is in between; mark the others open."""
    height, width = valid.shape
    row_labels, row_inverse_depth = np.empty(width, dtype=np.int32), np.empty(width, dtype=np.float32)
    on_row = np.arange(width) // step
    for row in range(height):
        if row % step == 0:
            for column in range(width):
                row_labels[column] = on_grid[row // step, on_row[column]]
                row_inverse_depth[column] = grid_inverse_depth[row // step, on_row[column]]
        for column in range(width):
            near = abs(row_inverse_depth[column] - inverse_depth[row, column]) < gap_per_m
            label = row_labels[column] if near & valid[row, column] else np.int32(0)
            labels[row, column] = label
            open_pixels[row, column] = valid[row, column] & (label == 0)
