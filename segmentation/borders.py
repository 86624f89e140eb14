"""Borders between surfaces at full resolution: each pixel goes to the surface that explains it best."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.inverse_depth import inverse_depth_lattice
from nurbseg.segmentation.noise import SQUARE_MOST
from nurbseg.segmentation.pieces import connected_pieces, joints, spread_labels
from nurbseg.segmentation.surface import NurbsSurface

#: Neighbours that vote are at most so far away along rows and columns, pixels.
_REACH = 2
#: Weight of one neighbour at a distance of one pixel against a squared residual in units of the noise.
_VOTE = 0.7
#: Vote of a neighbour across a gap in depth, in shares of another's.
_ACROSS_GAP = 0.25
_SWEEPS = 6
_OFFSETS = tuple(pair for pair in product(range(-_REACH, _REACH + 1), repeat=2) if pair != (0, 0))


def labels_of_every_pixel(
    on_grid: NDArray[np.int32],
    grid_per_m: NDArray[np.float32],
    per_m: NDArray[np.float32],
    valid: NDArray[np.bool_],
    config: SegmentationConfig,
) -> NDArray[np.int32]:
    """Give every pixel that has a point a label, from labels on every few rows and columns.

    Parameters
    ----------
    on_grid : (h, w) int32
        Labels on the grid, 0 for none.
    grid_per_m : (h, w) float32
        Inverse depth on the grid, 1/m.
    per_m, valid : (H, W) float32 and bool
        Inverse depth of every pixel, 1/m, and where there is a point.
    config : SegmentationConfig
        The grid's step and the gap in depth.

    Returns
    -------
    (H, W) int32
        The label of the place of the grid at or before the pixel, unless a gap in depth is in between:
        then that of the neighbour nearest in inverse depth. 0 only where there is no point.
    """
    step, (height, width) = config.decimation, valid.shape
    if step == 1:
        labels = on_grid.copy()
        open_pixels = valid & (labels == 0)
    else:
        at = np.ix_(np.arange(height) // step, np.arange(width) // step)
        labels = on_grid[at]
        across = np.abs(grid_per_m[at] - per_m) >= config.depth_gap_per_m
        open_pixels = valid & ((labels == 0) | across)
        labels[~valid | open_pixels] = 0
    return spread_labels(labels, open_pixels, per_m, config.depth_gap_per_m)


def refine_borders(
    labels: NDArray[np.int32],
    per_m: NDArray[np.float32],
    surfaces: Sequence[NurbsSurface | None],
    config: SegmentationConfig,
) -> NDArray[np.int32]:
    """Move borders to where the surfaces on both sides, carried beyond them, explain the points best.

    The cost of a label at a pixel is the squared residual of inverse depth in units of the noise, limited,
    less the votes of the neighbours, which weigh one over their distance and little across a gap in
    depth. Pixels with neighbours of another label take the cheapest of their labels, in a few sweeps
    (iterated conditional modes [1]_). What a border cuts off goes to its neighbours.

    Parameters
    ----------
    labels : (H, W) int32
        1 to the number of surfaces; 0 where there is no point.
    per_m : (H, W) float32
        Inverse depth, 1/m.
    surfaces : sequence of NurbsSurface or None
        That of each label; a label without one explains nothing.
    config : SegmentationConfig
        Noise, gap and smallest piece.

    Returns
    -------
    (H, W) int32
        The new labels. A label that would lose its last pixel keeps those it had.

    References
    ----------
    .. [1] J. Besag, "On the statistical analysis of dirty pictures", Journal of the Royal Statistical
       Society B 48(3), 1986.
    """
    if len(surfaces) < 2 or not labels.any():
        return labels
    explained = _Explanations(labels, surfaces)
    refined = labels.copy()
    todo = np.ones(labels.shape, dtype=np.bool_)
    for sweep in range(_SWEEPS):
        rows, columns = np.nonzero(_near_borders(refined) & todo)
        if sweep > 1:
            # By then neighbours that only change places are left: one of two at a time.
            turn = (rows + columns + sweep) % 2 == 0
            rows, columns = rows[turn], columns[turn]
        best = _cheapest(refined, per_m, rows, columns, explained, config.noise_per_m, config.depth_gap_per_m)
        changed = best != refined[rows, columns]
        if not changed.any() and sweep > 2:
            break
        refined[rows[changed], columns[changed]] = best[changed]
        if sweep > 0:
            moved = np.zeros(labels.shape, dtype=np.uint8)
            moved[rows[changed], columns[changed]] = 1
            kernel = np.ones((2 * _REACH + 1, 2 * _REACH + 1), dtype=np.uint8)
            todo = (cv2.dilate(moved, kernel) > 0) | (todo & (sweep < 2))
    refined = _without_severed_pieces(refined, per_m, config)
    lost = np.setdiff1d(np.unique(labels), np.unique(refined))
    kept = np.isin(labels, lost)
    refined[kept] = labels[kept]
    return refined


def _near_borders(labels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Find labelled pixels with another label within reach."""
    kernel = np.ones((2 * _REACH + 1, 2 * _REACH + 1), dtype=np.uint8)
    image = labels.astype(np.float32)
    largest = cv2.dilate(image, kernel)
    image[labels == 0] = np.inf
    least = cv2.erode(image, kernel)
    return np.asarray((labels > 0) & (largest != least))


class _Explanations:
    """Inverse depths of the surfaces of some labels on the windows of these, computed when asked for."""

    def __init__(self, labels: NDArray[np.int32], surfaces: Sequence[NurbsSurface | None]) -> None:
        self._surfaces = surfaces
        self._shape = labels.shape
        self._windows: dict[int, tuple[int, int, NDArray[np.float32]]] = {}
        self._extents = _extents(labels, len(surfaces))

    def at(self, label: int, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return the inverse depth of a label's surface at some pixels, inf where it does not reach."""
        surface = self._surfaces[label - 1]
        if surface is None:
            return np.full(rows.size, np.inf, dtype=np.float32)
        if label not in self._windows:
            margin = _REACH * _SWEEPS
            top, left, bottom, right = self._extents[label - 1]
            top, left = max(top - margin, 0), max(left - margin, 0)
            bottom, right = min(bottom + margin, self._shape[0]), min(right + margin, self._shape[1])
            u, v = np.arange(left, right, dtype=np.float64), np.arange(top, bottom, dtype=np.float64)
            image = inverse_depth_lattice(surface, u, v)[0].astype(np.float32)
            self._windows[label] = top, left, image
        top, left, image = self._windows[label]
        r, c = rows - top, columns - left
        inside = (r >= 0) & (r < image.shape[0]) & (c >= 0) & (c < image.shape[1])
        values = np.full(rows.size, np.inf, dtype=np.float32)
        values[inside] = image[r[inside], c[inside]]
        return values


def _extents(labels: NDArray[np.int32], count: int) -> list[tuple[int, int, int, int]]:
    """Return the tight window of each label from 1 on; an empty one where it has no pixel."""
    rows, columns = np.nonzero(labels)
    values = labels[rows, columns] - 1
    top, left = (np.full(count, np.iinfo(np.intp).max) for _ in range(2))
    bottom, right = (np.full(count, -1) for _ in range(2))
    for least, most, place in ((top, bottom, rows), (left, right, columns)):
        np.minimum.at(least, values, place)
        np.maximum.at(most, values, place)
    empty = bottom < 0
    top[empty] = left[empty] = 0
    return [
        (int(a), int(b), int(c) + 1, int(d) + 1) for a, b, c, d in zip(top, left, bottom, right, strict=True)
    ]


def _cheapest(
    labels: NDArray[np.int32],
    per_m: NDArray[np.float32],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    explained: _Explanations,
    noise_per_m: float,
    gap_per_m: float,
) -> NDArray[np.int32]:
    """Return the cheapest label of some pixels among their own and their neighbours'."""
    if rows.size == 0:
        return np.zeros(0, dtype=np.int32)
    pad = [(_REACH, _REACH)] * 2
    padded, depths = np.pad(labels, pad), np.pad(per_m, pad)
    own = per_m[rows, columns]
    near = np.empty((len(_OFFSETS), rows.size), dtype=np.int32)
    weight = np.empty((len(_OFFSETS), rows.size), dtype=np.float32)
    for n, (step_v, step_u) in enumerate(_OFFSETS):
        at = rows + (_REACH + step_v), columns + (_REACH + step_u)
        near[n] = padded[at]
        distance = float(np.hypot(step_v, step_u))
        across = np.abs(depths[at] - own) >= gap_per_m * np.sqrt(distance)
        weight[n] = np.where(across, _ACROSS_GAP, 1.0) * (_VOTE / distance)
    best = labels[rows, columns].copy()
    cost = np.full(rows.size, np.inf, dtype=np.float32)
    for label in np.unique(np.append(near, best)):
        if label == 0:
            continue
        votes = np.einsum("nk,nk->k", near == label, weight)
        asked = np.flatnonzero((votes > 0) | (labels[rows, columns] == label))
        residuals = explained.at(int(label), rows[asked], columns[asked]) - own[asked]
        value = np.minimum(np.square(residuals / np.float32(noise_per_m)), np.float32(SQUARE_MOST))
        value -= votes[asked]
        cheaper = value < cost[asked]
        best[asked[cheaper]] = label
        cost[asked[cheaper]] = value[cheaper]
    return best


def _without_severed_pieces(
    labels: NDArray[np.int32], per_m: NDArray[np.float32], config: SegmentationConfig
) -> NDArray[np.int32]:
    """Give small pieces to their neighbours where they are not the largest piece of their label."""
    joined = joints(per_m, labels > 0, config.depth_gap_per_m)
    count, pieces = connected_pieces(labels, joined)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    label_of = np.zeros(count + 1, dtype=np.int32)
    label_of[pieces.ravel()] = labels.ravel()
    unit = labels.size / (640.0 * 480.0)
    kept = sizes >= config.piece_pixels_min * unit
    # In ascending order of size, so that the largest piece of each label is written last.
    order = np.argsort(sizes, kind="stable")
    largest = np.zeros(int(labels.max()) + 1, dtype=np.intp)
    largest[label_of[order]] = order
    kept[largest[1:]] = True
    kept[0] = True
    severed = ~kept[pieces]
    cleaned = np.where(severed, 0, labels)
    return spread_labels(cleaned, severed, per_m, config.depth_gap_per_m)


__all__ = ["labels_of_every_pixel", "refine_borders"]
