"""Connected pieces of segments where neighbours across a gap in depth are not connected."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Joints:
    """Which neighbours on a pixel grid have points with no gap in depth between them.

    Parameters
    ----------
    right : (h, w) bool
        Whether a place is joined to the one to its right; False in the last column.
    down : (h, w) bool
        Whether it is joined to the one below; False in the last row.
    """

    right: NDArray[np.bool_]
    down: NDArray[np.bool_]

    def inside(self, window: tuple[int, int, int, int]) -> Joints:
        """Return those of a window (first row and column, one past the last of each)."""
        top, left, bottom, right = window
        return Joints(self.right[top:bottom, left:right], self.down[top:bottom, left:right])


def joints(inverse_depth: NDArray[np.float32], valid: NDArray[np.bool_], gap_per_m: float) -> Joints:
    """Join neighbours whose inverse depths differ by less than a gap.

    Parameters
    ----------
    inverse_depth : (h, w) float32
        One over depth, 1/m.
    valid : (h, w) bool
        Where there is a point.
    gap_per_m : float
        Smallest gap, 1/m.

    Returns
    -------
    Joints
        Between points only.
    """
    right, down = np.zeros_like(valid), np.zeros_like(valid)
    right[:, :-1] = valid[:, :-1] & valid[:, 1:]
    right[:, :-1] &= np.abs(inverse_depth[:, 1:] - inverse_depth[:, :-1]) < gap_per_m
    down[:-1] = valid[:-1] & valid[1:]
    down[:-1] &= np.abs(inverse_depth[1:] - inverse_depth[:-1]) < gap_per_m
    return Joints(right, down)


def connected_pieces(labels: NDArray[np.int32], joined: Joints) -> tuple[int, NDArray[np.int32]]:
    """Find the pieces of equal label that are connected through joined neighbours.

    Parameters
    ----------
    labels : (h, w) int32
        0 belongs to no piece.
    joined : Joints
        Of the same places.

    Returns
    -------
    count : int
        Number of pieces.
    pieces : (h, w) int32
        1 to `count`; 0 where the label is 0.
    """
    height, width = labels.shape
    # Places at even rows and columns, joints between them: so a plain component search sees the gaps.
    lattice = np.zeros((2 * height - 1, 2 * width - 1), dtype=np.uint8)
    inside = labels > 0
    lattice[::2, ::2] = inside
    lattice[::2, 1::2] = joined.right[:, :-1] & inside[:, :-1] & (labels[:, 1:] == labels[:, :-1])
    lattice[1::2, ::2] = joined.down[:-1] & inside[:-1] & (labels[1:] == labels[:-1])
    count, found = cv2.connectedComponents(lattice, connectivity=4, ltype=cv2.CV_32S)
    return count - 1, np.asarray(found[::2, ::2], dtype=np.int32)


def labels_of_pieces(labels: NDArray[np.int32], count: int, pieces: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the label of each piece, (count + 1,) int32, from those of every place; 0 for number 0."""
    # Every piece has a place that follows one of another piece, or the first of all.
    flat = pieces.reshape(-1)
    starts = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    label_of = np.zeros(count + 1, dtype=np.int32)
    label_of[flat[:1]] = labels.reshape(-1)[:1]
    label_of[flat.take(starts)] = labels.take(starts)
    return label_of


def spread_labels(
    labels: NDArray[np.int32],
    wanted: NDArray[np.bool_],
    inverse_depth: NDArray[np.float32],
    gap_per_m: float,
) -> NDArray[np.int32]:
    """Give unlabelled places the label of the neighbour nearest in inverse depth, from the rim inwards.

    Parameters
    ----------
    labels : (h, w) int32
        0 is no label.
    wanted : (h, w) bool
        Places to label, unlabelled so far. Those that no chain of them connects to a label take that of
        the nearest labelled place.
    inverse_depth : (h, w) float32
        One over depth, 1/m.
    gap_per_m : float
        Labels go across a gap in depth only where nothing else is left to do, 1/m.

    Returns
    -------
    (h, w) int32
        The labels, with those of the wanted places.
    """
    if not wanted.any():
        return labels.copy()
    # With a margin of one place all have four neighbours.
    padded = np.pad(labels, 1)
    width = padded.shape[1]
    flat, depths = padded.reshape(-1), np.pad(inverse_depth, 1).reshape(-1)
    rows, columns = np.divmod(np.flatnonzero(wanted), width - 2)
    places = (rows + 1) * width + columns + 1
    neighbors = np.array([[1], [width], [-1], [-width]]) + places
    steps = np.abs(depths[neighbors] - depths[places])
    limit = gap_per_m
    while places.size:
        around = flat[neighbors]
        distances = np.where(around > 0, steps, np.float32(np.inf))
        nearest = distances.argmin(axis=0)
        each = np.arange(places.size)
        least = distances[nearest, each]
        found = least < limit
        if not found.any():
            if limit == np.inf:
                break
            limit = np.inf
            continue
        limit = gap_per_m
        flat[places[found]] = around[nearest[found], each[found]]
        left = ~found
        places, neighbors, steps = places[left], neighbors[:, left], steps[:, left]
    labels = np.ascontiguousarray(padded[1:-1, 1:-1])
    rows, columns = places // width - 1, places % width - 1
    if rows.size and labels.any():
        _, source = cv2.distanceTransformWithLabels(
            (labels == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        label_of = np.zeros(int(source.max()) + 1, dtype=np.int32)
        label_of[source[labels > 0]] = labels[labels > 0]
        labels[rows, columns] = label_of[source[rows, columns]]
    return labels


def large_pieces(
    labels: NDArray[np.int32],
    joined: Joints,
    inverse_depth: NDArray[np.float32],
    *,
    gap_per_m: float,
    places_min: float,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Find the connected pieces that are large enough, and give them what the small ones hold.

    Parameters
    ----------
    labels : (h, w) int32
        0 belongs to no piece.
    joined, inverse_depth : Joints, (h, w) float32
        Of the same places.
    gap_per_m : float
        Gap in depth, 1/m.
    places_min : float
        Smallest number of places of a piece.

    Returns
    -------
    pieces : (h, w) int32
        1 to the number of pieces kept, 0 where the label is 0; all 0 where no piece is large enough.
    labels_of : (pieces,) int32
        Label that each piece had.
    """
    count, found = connected_pieces(labels, joined)
    sizes = np.bincount(found.ravel(), minlength=count + 1)
    kept = np.flatnonzero(sizes[1:] >= places_min) + 1
    number = np.zeros(count + 1, dtype=np.int32)
    number[kept] = np.arange(1, kept.size + 1)
    pieces = number[found]
    label_of = labels_of_pieces(labels, count, found)
    homeless = (labels > 0) & (pieces == 0)
    if kept.size and homeless.any():
        pieces = spread_labels(pieces, homeless, inverse_depth, gap_per_m)
    return pieces, label_of[kept]


__all__ = ["Joints", "connected_pieces", "joints", "labels_of_pieces", "large_pieces", "spread_labels"]
