"""Labels of every pixel, from those on the grid and those of the pixels before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F32, I32, U16, compiled, inlined_once
from nurbseg.segmentation.extended.borders import ACROSS_GAP, Deviations
from nurbseg.segmentation.surfaces.lattice import Samples, SurfaceLattice
from nurbseg.segmentation.surfaces.metrics import SQUARE_MOST

#: Vote of a neighbour at a distance of one pixel, and of a diagonal one.
_VOTE, _DIAGONAL_VOTE = 1.4, 1.4 / 2**0.5


def spread_to_pixels(
    before: NDArray[np.uint16], on_grid: NDArray[np.int32], inverse_depth: NDArray[np.float32], step: int
) -> NDArray[np.uint16]:
    """Apply changes of labels on the grid to its pixels; the others keep their label.

    Parameters
    ----------
    before : (H, W) uint16
        Label that each pixel had.
    on_grid : (h, w) int32
        Labels on every `step`-th row and column.
    inverse_depth : (H, W) float32
        Inverse depth, 1/m; 0 where there is no point, and so no label.

    Returns
    -------
    (H, W) uint16
        The labels.
    """
    labels = np.empty_like(before)
    _spread(before, on_grid, inverse_depth, step, labels)
    return labels


def relax_borders(
    labels: NDArray[np.uint16],
    inverse_depth: NDArray[np.float32],
    lattice: SurfaceLattice,
    deviations: Deviations,
    *,
    gap_per_m: float,
) -> NDArray[np.uint16]:
    """Give every pixel at a border the cheapest of its own label, the largest and the smallest next to it.

    One sweep of iterated conditional modes, as in `refine_borders`; later frames continue it.

    Parameters
    ----------
    labels : (H, W) uint16
        Labels of pixels that have a point, 0 where not known yet.
    inverse_depth : (H, W) float32
        Inverse depth, 1/m; 0 where there is no point.
    lattice : SurfaceLattice
        Of the labels' surfaces.
    deviations : Deviations
        Of these surfaces.
    gap_per_m : float
        Smallest gap, 1/m.

    Returns
    -------
    (H, W) uint16
        The new labels.
    """
    relaxed = labels.copy()
    _relax(labels, inverse_depth, lattice.samples, lattice.step, deviations, gap_per_m, relaxed)
    return relaxed


@compiled
def _spread(before: U16, on_grid: I32, inverse_depth: F32, step: int, labels: U16) -> None:
    """Give the pixels of a grid pixel its label where it is another one than before."""
    height, width = before.shape
    # New labels of the pixels of a row of grid pixels, -1 for none.
    taken, on_row = np.empty(width, dtype=np.int32), np.arange(width) // step
    for r in range(height):
        known, depths, spread = before[r], inverse_depth[r], labels[r]
        if r % step == 0:
            decided = on_grid[r // step]
            for c in range(width):
                n = on_row[c]
                taken[c] = -1 if decided[n] == known[n * step] else decided[n]
        for c in range(width):
            label = known[c] if taken[c] < 0 else taken[c]
            spread[c] = label if depths[c] > 0 else 0


@compiled
def _relax(
    labels: U16,
    inverse_depth: F32,
    samples: Samples,
    step: int,
    deviations: Deviations,
    gap: float,
    relaxed: U16,
) -> None:
    height, width = labels.shape
    turns, beside = np.empty(width, dtype=np.bool_), np.empty(width, dtype=np.bool_)
    # By the number of nonzero offsets; a pixel has no vote for itself.
    votes, none = np.array([0.0, _VOTE, _DIAGONAL_VOTE]), np.int64(1 << 16)
    for r in range(height):
        above, below = max(r - 1, 0), min(r + 2, height)
        # Most pixels have only neighbours of their own label.
        for c in range(width):
            turns[c] = (labels[above, c] != labels[r, c]) | (labels[below - 1, c] != labels[r, c])
        for c in range(1, width):
            beside[c] = (labels[r, c - 1] != labels[r, c]) | turns[c - 1] | turns[c]
        beside[0] = turns[0]
        for c in range(width):
            own = inverse_depth[r, c]
            if not (beside[c] or beside[min(c + 1, width - 1)]) or not own > 0:
                continue
            left, right = max(c - 1, 0), min(c + 2, width)
            before, most, least = np.int64(labels[r, c]), np.int64(0), none
            for y in range(above, below):
                for x in range(left, right):
                    near = np.int64(labels[y, x])
                    most = near if near > most else most
                    least = near if 0 < near < least else least
            if most <= least:
                continue
            for_before, for_most, for_least = 0.0, 0.0, 0.0
            for y in range(above, below):
                for x in range(left, right):
                    near, vote = labels[y, x], votes[(y != r) + (x != c)]
                    vote *= 1.0 if abs(inverse_depth[y, x] - own) < gap else ACROSS_GAP
                    for_before += vote if near == before else 0.0
                    for_most += vote if near == most else 0.0
                    for_least += vote if near == least else 0.0
            row, column = r // step, c // step
            at = (row, column, (r - step * row) / step, (c - step * column) / step)
            cheapest = np.inf
            for label, vote in ((before, for_before), (most, for_most), (least, for_least)):
                if label == 0 or (label == before and cheapest < np.inf):
                    continue
                residual = deviations.precision_m[label] * (_explained(samples, label, at) - own)
                cost = min(residual * residual, SQUARE_MOST) + deviations.penalty[label] - vote
                if cost < cheapest:
                    cheapest = cost
                    relaxed[r, c] = label


@inlined_once
def _explained(samples: Samples, label: np.int64, at: tuple[int, int, float, float]) -> float:
    """Return a surface's inverse depth at and beyond a grid pixel, linear in between; inf where it ends."""
    values, windows = samples
    row, column, down, across = at
    top, left, bottom, right, start = windows[label]
    # No extrapolation beyond the last row and column.
    under, beside = (1 if down > 0 else 0), (1 if across > 0 else 0)
    if not (top <= row < bottom - under and left <= column < right - beside):
        return np.inf
    n = start + (row - top) * (right - left) + column - left
    below = n + under * (right - left)
    upper = values[n] + across * (values[n + beside] - values[n])
    lower = values[below] + across * (values[below + beside] - values[below])
    return float(upper + down * (lower - upper))
