"""Labels of every pixel from those on a coarser grid: by the cuts of a tree, or by depth."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, I32, U16, Bool, compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.labels.spreading import spread_labels
from nurbseg.segmentation.points.grid import PixelGrid
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, depth_first, leaf_ranges


def upsample_labels(
    cloud: PointMap,
    grid: PixelGrid,
    root: Node,
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
    root : Node
        Of the tree, in which every segment that has parts has a cut.
    vectors_of : callable
        Returns the (N, D) float32 feature vectors of some flat pixels of the image.

    Returns
    -------
    (H, W) uint16
        Index of each pixel's leaf in depth-first order plus one; 0 where there is no point.
    """
    nodes = depth_first(root)
    on_grid = np.zeros(grid.shape, dtype=np.uint16)
    for label, leaf in enumerate((node for node in nodes if not node.children), start=1):
        on_grid.reshape(-1)[leaf.grid_pixels] = label
    if grid.step == 1:
        return on_grid

    # The leaves at the corners of each cell; the last row and column are repeated.
    padded = np.pad(on_grid, ((0, 1), (0, 1)), mode="edge")
    corners = np.stack([padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]])
    greatest = corners.max(axis=0)
    agreed = ((corners == greatest) | (corners == 0)).all(axis=0)
    height, width = grid.image_shape
    cells = np.repeat(np.where(agreed, greatest, 0), grid.step, axis=0)[:height]
    labels = np.where(cloud.valid, np.repeat(cells, grid.step, axis=1)[:, :width], 0)
    labels[:: grid.step, :: grid.step] = on_grid

    undecided = np.flatnonzero((labels == 0) & cloud.valid)
    rows, columns = np.divmod(undecided, width)
    candidates = corners[:, rows // grid.step, columns // grid.step]
    labels.reshape(-1)[undecided] = _decide(nodes, candidates, vectors_of(undecided))
    return labels


def _decide(
    nodes: list[Node], candidates: NDArray[np.uint16], vectors: NDArray[np.float32]
) -> NDArray[np.uint16]:
    """Classify pixels down the tree, by the cuts both of whose parts hold candidates.

    `candidates` (4, N) holds labels of leaves, 0 for none; without any, all leaves are candidates.
    """
    labels = np.zeros(candidates.shape[1], dtype=np.uint16)
    ranges = leaf_ranges(nodes)
    stack = [(nodes[0], np.arange(labels.size))]
    while stack:
        node, pixels = stack.pop()
        first, end = ranges[node.name]
        if not node.children or node.cut is None:
            labels[pixels] = first
        elif pixels.size:
            near, middle = candidates[:, pixels], ranges[node.children[1].name][0]
            in_first = np.any((near >= first) & (near < middle), axis=0)
            second = np.any((near >= middle) & (near < end), axis=0)
            asked = in_first == second
            second[asked] = node.cut.classify(vectors[pixels[asked]])
            stack += [(node.children[0], pixels[~second]), (node.children[1], pixels[second])]
    return labels


class CarriedLabels(NamedTuple):
    """Labels of the frame before.

    Parameters
    ----------
    labels : (H, W) uint16
        Of pixels at their present place; 0 for none.
    number_of : (N,) uint16
        Label in this frame of each, 0 for one that is gone.
    """

    labels: NDArray[np.uint16]
    number_of: NDArray[np.uint16]


def upsample_by_depth(
    on_grid: NDArray[np.int32],
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    config: SegmentationConfig,
    carried: CarriedLabels | None = None,
) -> NDArray[np.int32]:
    """Give every pixel that has a point a label, from labels on every few rows and columns.

    Parameters
    ----------
    on_grid : (h, w) int32
        Labels on the grid, 0 for none.
    inverse_depth, valid : (H, W) float32 and bool
        Inverse depth of every pixel, 1/m, and where there is a point.
    config : SegmentationConfig
        The grid's step and the gap in depth.
    carried : CarriedLabels, optional
        Labels of the frame before, which pixels keep where the one of their grid pixel has not changed.

    Returns
    -------
    (H, W) int32
        The label of the grid pixel at or before the pixel, or, across a gap in depth, that of the neighbor
        nearest in inverse depth. 0 only where there is no point.
    """
    gap_per_m = config.extended.inverse_depth_gap
    labels = _taken_over(on_grid, inverse_depth, valid, config.decimation, np.float32(gap_per_m))
    if carried is not None:
        _keep(carried.labels, carried.number_of, on_grid, valid, config.decimation, labels)
    missed = np.flatnonzero(valid & (labels == 0))
    spread_labels(labels, missed, inverse_depth, gap_per_m)
    return labels


@compiled
def _taken_over(on_grid: I32, inverse_depth: F32, valid: Bool, step: int, gap_per_m: np.float32) -> I32:
    """Give pixels the label of their grid pixel unless a gap is in between, and the others none."""
    height, width = valid.shape
    labels = np.empty((height, width), dtype=np.int32)
    row_labels, row_inverse_depth = np.empty(width, dtype=np.int32), np.empty(width, dtype=np.float32)
    on_row = np.arange(width) // step
    for row in range(height):
        if row % step == 0:
            for column in range(width):
                row_labels[column] = on_grid[row // step, on_row[column]]
                row_inverse_depth[column] = inverse_depth[row, on_row[column] * step]
        for column in range(width):
            near = abs(row_inverse_depth[column] - inverse_depth[row, column]) < gap_per_m
            labels[row, column] = row_labels[column] if near & valid[row, column] else np.int32(0)
    return labels


@compiled
def _keep(carried: U16, number_of: U16, on_grid: I32, valid: Bool, step: int, labels: I32) -> None:
    """Give pixels the label that was carried to them, if that of their grid pixel was carried, too."""
    height, width = labels.shape
    on_row = np.arange(width) // step
    kept = np.empty(width, dtype=np.int32)
    for row in range(height):
        if row % step == 0:
            for column in range(on_grid.shape[1]):
                label = np.int32(number_of[carried[row, column * step]])
                kept[column] = label if label == on_grid[row // step, column] else np.int32(0)
        for column in range(width):
            label = np.int32(number_of[carried[row, column]])
            if label > 0 and kept[on_row[column]] > 0 and valid[row, column]:
                labels[row, column] = label
