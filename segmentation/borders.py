"""Borders between surfaces at full resolution: each pixel goes to the surface that explains it best."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.inverse_depth import inverse_depth_image_of
from nurbseg.segmentation.noise import SQUARE_MOST
from nurbseg.segmentation.pieces import connected_pieces, joints
from nurbseg.segmentation.spreading import spread_labels
from nurbseg.segmentation.surface import NurbsSurface

#: Neighbours that vote are at most so far away along rows and columns, pixels.
_REACH = 2
#: Weight of one neighbour at a distance of one pixel against a squared residual in units of the noise.
_VOTE = 0.7
#: Vote of a neighbour across a gap in depth, in shares of another's.
_ACROSS_GAP = 0.25
_SWEEPS = 6
#: Pixels judged at once, so that their neighbours stay in the cache.
_BLOCK = 4096
_OFFSETS = tuple(pair for pair in product(range(-_REACH, _REACH + 1), repeat=2) if pair != (0, 0))
_DISTANCES = np.hypot(*np.array(_OFFSETS).T).astype(np.float32)


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
        labels = np.repeat(np.repeat(on_grid, step, axis=1)[:, :width], step, axis=0)[:height]
        steps = np.repeat(np.repeat(grid_per_m, step, axis=1)[:, :width], step, axis=0)[:height]
        steps -= per_m
        open_pixels = np.abs(steps, out=steps) >= config.depth_gap_per_m
        open_pixels |= labels == 0
        open_pixels &= valid
        labels *= valid & ~open_pixels
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
    sides = _Sides(labels, per_m, surfaces, config.noise_per_m, config.depth_gap_per_m)
    pixels = np.flatnonzero(_near_borders(labels))
    for sweep in range(_SWEEPS):
        if sweep > 1:
            # By then neighbours that only change places are left: one of two at a time.
            rows, columns = np.divmod(pixels, labels.shape[1])
            pixels = pixels[(rows + columns + sweep) % 2 == 0]
        if pixels.size == 0:
            break
        # Only where a label has changed within reach can another one be the cheapest now.
        pixels = sides.around(sides.improve(pixels))
    refined = _without_severed_pieces(sides.labels(), per_m, config)
    count = len(surfaces) + 1
    lost = np.bincount(labels.ravel(), minlength=count) > 0
    lost &= np.bincount(refined.ravel(), minlength=count) == 0
    lost[0] = False
    if lost.any():
        kept = lost[labels]
        refined[kept] = labels[kept]
    return refined


def _near_borders(labels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Find labelled pixels with another label within reach."""
    kernel = np.ones((2 * _REACH + 1, 2 * _REACH + 1), dtype=np.uint8)
    # Narrow integers: the extremes of many pixels are found at once.
    image: NDArray[np.integer] = labels.astype(np.uint8 if labels.max() < 255 else np.uint16)
    largest = cv2.dilate(image, kernel)
    # Less 1, what has no label is the largest of numbers.
    least = cv2.erode(image - image.dtype.type(1), kernel) + image.dtype.type(1)
    return np.asarray((image > 0) & (largest != least))


class _Sides:
    """Labels at their borders, and what each pixel would cost on the other side.

    Pixels are numbered in an image with a margin as wide as the reach, so that all have all neighbours.
    """

    def __init__(
        self,
        labels: NDArray[np.int32],
        per_m: NDArray[np.float32],
        surfaces: Sequence[NurbsSurface | None],
        noise_per_m: float,
        gap_per_m: float,
    ) -> None:
        self._shape = labels.shape
        self._labels = np.pad(labels, _REACH)
        self._per_m = np.pad(per_m, _REACH).ravel()
        self._per_deviation = np.float32(1.0 / noise_per_m)
        width = self._labels.shape[1]
        self._steps = np.array([down * width + across for down, across in _OFFSETS])[:, np.newaxis]
        self._votes = (_VOTE / _DISTANCES)[:, np.newaxis]
        self._votes_across = np.float32(_ACROSS_GAP) * self._votes
        self._gaps = (gap_per_m * np.sqrt(_DISTANCES))[:, np.newaxis]
        self._explain(labels, surfaces)

    def labels(self) -> NDArray[np.int32]:
        """Return the labels as they are now, (H, W)."""
        return np.ascontiguousarray(self._labels[_REACH:-_REACH, _REACH:-_REACH])

    def improve(self, pixels: NDArray[np.intp]) -> NDArray[np.intp]:
        """Give pixels, flat in the image, the cheapest label around them; return those that changed."""
        best = [self._cheapest(pixels[n : n + _BLOCK]) for n in range(0, pixels.size, _BLOCK)]
        rows, columns = np.divmod(pixels, self._shape[1])
        flat, numbers = self._labels.reshape(-1), (rows + _REACH) * self._labels.shape[1] + columns + _REACH
        cheapest = np.concatenate(best)
        changed = cheapest != flat[numbers]
        flat[numbers[changed]] = cheapest[changed]
        moved: NDArray[np.intp] = pixels[changed]
        return moved

    def _cheapest(self, pixels: NDArray[np.intp]) -> NDArray[np.int32]:
        """Return the cheapest label around each pixel."""
        rows, columns = np.divmod(pixels, self._shape[1])
        numbers = (rows + _REACH) * self._labels.shape[1] + columns + _REACH
        flat = self._labels.reshape(-1)
        at = self._steps + numbers
        near, own = flat.take(at), self._per_m.take(numbers)
        steps = self._per_m.take(at)
        steps -= own
        weights = np.where(np.abs(steps, out=steps) >= self._gaps, self._votes_across, self._votes)

        def cost(
            label: NDArray[np.int32], which: NDArray[np.intp], same: NDArray[np.bool_]
        ) -> NDArray[np.float32]:
            residual = self._explained(label, rows[which], columns[which])
            residual -= own[which]
            residual *= self._per_deviation
            np.minimum(np.square(residual, out=residual), np.float32(SQUARE_MOST), out=residual)
            some = weights if which.size == pixels.size else weights[:, which]
            residual -= np.where(same, some, np.float32(0.0)).sum(axis=0)
            return residual

        before = flat[numbers]
        which = np.arange(pixels.size)
        same = near == before
        best: NDArray[np.int32] = before.copy()
        least = cost(before, which, same)
        # The other labels around, the largest first; few pixels see more than one.
        others = near
        while True:
            others[same] = 0
            label = others.max(axis=0)
            some = np.flatnonzero(label)
            if some.size == 0:
                return best
            if some.size < label.size:
                which, label, others = which[some], label[some], others[:, some]
            same = others == label
            value = cost(label, which, same)
            better = (value < least[which]) | ((value == least[which]) & (label < best[which]))
            best[which[better]], least[which[better]] = label[better], value[better]

    def around(self, pixels: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the labelled pixels within reach of some."""
        rows, columns = np.divmod(pixels, self._shape[1])
        numbers = (rows + _REACH) * self._labels.shape[1] + columns + _REACH
        reached = np.zeros(self._labels.size, dtype=np.bool_)
        reached[numbers] = True
        reached[self._steps + numbers] = True
        image = reached.reshape(self._labels.shape) & (self._labels > 0)
        found: NDArray[np.intp] = np.flatnonzero(image[_REACH:-_REACH, _REACH:-_REACH])
        return found

    def _explain(self, labels: NDArray[np.int32], surfaces: Sequence[NurbsSurface | None]) -> None:
        """Evaluate each surface wherever its label can get, one after the other in one array."""
        height, width = self._shape
        margin = _REACH * _SWEEPS
        windows = []
        self._first = np.zeros(len(surfaces) + 1, dtype=np.intp)
        self._row_length = np.zeros(len(surfaces) + 1, dtype=np.intp)
        start = 0
        for label, (top, left, bottom, right) in enumerate(_extents(labels, len(surfaces)), start=1):
            top, left = max(top - margin, 0), max(left - margin, 0)
            bottom, right = min(bottom + margin, height), min(right + margin, width)
            surface = surfaces[label - 1]
            self._row_length[label] = right - left
            self._first[label] = start - top * (right - left) - left
            start += (bottom - top) * (right - left)
            if surface is None:
                windows.append(np.full((bottom - top) * (right - left), np.inf, dtype=np.float32))
                continue
            u, v = np.arange(left, right, dtype=np.float64), np.arange(top, bottom, dtype=np.float64)
            windows.append(inverse_depth_image_of(surface, u, v).ravel())
        self._inverse_depths = np.concatenate(windows)

    def _explained(
        self, labels: NDArray[np.int32], rows: NDArray[np.intp], columns: NDArray[np.intp]
    ) -> NDArray[np.float32]:
        """Return the inverse depth of the surfaces of some labels, each at its own pixel."""
        explained: NDArray[np.float32] = self._inverse_depths.take(
            self._first.take(labels) + rows * self._row_length.take(labels) + columns
        )
        return explained


def _extents(labels: NDArray[np.int32], count: int) -> list[tuple[int, int, int, int]]:
    """Return the tight window of each label from 1 on; an empty one where it has no pixel."""
    height, width = labels.shape
    # Where labels change along a row or column, and at its ends, is where windows can end.
    in_row, in_column = (np.zeros((extent, count + 1), dtype=np.bool_) for extent in (height, width))
    for across, image in ((in_row, labels), (in_column, np.asarray(cv2.transpose(labels)))):
        turns = np.ones(image.shape, dtype=np.bool_)
        np.not_equal(image[:, 1:], image[:, :-1], out=turns[:, 1:])
        places = np.flatnonzero(turns)
        across[places // image.shape[1], image.take(places)] = True
    windows = []
    for label in range(1, count + 1):
        rows, columns = np.flatnonzero(in_row[:, label]), np.flatnonzero(in_column[:, label])
        if rows.size == 0:
            windows.append((0, 0, 0, 0))
            continue
        windows.append((int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1))
    return windows


def _without_severed_pieces(
    labels: NDArray[np.int32], per_m: NDArray[np.float32], config: SegmentationConfig
) -> NDArray[np.int32]:
    """Give small pieces to their neighbours where they are not the largest piece of their label."""
    found = connected_pieces(labels, joints(per_m, labels > 0, config.depth_gap_per_m))
    unit = labels.size / (640.0 * 480.0)
    kept = found.large(config.piece_pixels_min * unit, int(labels.max()))
    if kept[1:].all():
        return labels
    severed = (labels > 0) & ~kept[found.numbers]
    cleaned = np.where(severed, 0, labels)
    return spread_labels(cleaned, severed, per_m, config.depth_gap_per_m)


__all__ = ["labels_of_every_pixel", "refine_borders"]
