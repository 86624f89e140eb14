"""Labels of every pixel of a frame, from those on the grid and those that pixels had before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.compiled import compiled
from nurbseg.segmentation.lattice import SurfaceLattice
from nurbseg.segmentation.noise import SQUARE_MOST

#: Vote of a neighbour at a distance of one pixel, and of a diagonal one.
_VOTE, _DIAGONAL_VOTE = 1.4, 1.4 / 2**0.5
#: Vote of a neighbour across a gap in depth, in shares of another's.
_ACROSS_GAP = 0.25


def spread_to_pixels(
    before: NDArray[np.uint16], on_grid: NDArray[np.int32], per_m: NDArray[np.float32], step: int
) -> NDArray[np.uint16]:
    """Take over what was decided on the grid; where nothing was, a pixel keeps its label.

    Parameters
    ----------
    before : (H, W) uint16
        Label that each pixel had.
    on_grid : (h, w) int32
        Labels on the grid.
    per_m : (H, W) float32
        Inverse depth, 1/m; 0 where there is no point, and so no label.
    step : int
        Pixels from one place of the grid to the next.

    Returns
    -------
    (H, W) uint16
        The labels.
    """
    labels = np.empty_like(before)
    _spread(before, on_grid, per_m, step, labels)
    return labels


def settled_borders(
    labels: NDArray[np.uint16],
    per_m: NDArray[np.float32],
    lattice: SurfaceLattice,
    *,
    noise_per_m: float,
    gap_per_m: float,
) -> NDArray[np.uint16]:
    """Give every pixel at a border the cheapest of its own label, the largest and the least beside it.

    One pass of iterated conditional modes, as borders are refined in a first frame; passes of later frames
    go on with it.

    Parameters
    ----------
    labels : (H, W) uint16
        Labels of all pixels that have a point, or 0 where that is not known yet.
    per_m : (H, W) float32
        Inverse depth, 1/m; 0 where there is no point.
    lattice : SurfaceLattice
        Of the labels' surfaces.
    noise_per_m, gap_per_m : float
        Standard deviation of inverse depth, and smallest gap, 1/m.

    Returns
    -------
    (H, W) uint16
        The new labels.
    """
    settled = labels.copy()
    _settle(
        labels,
        per_m,
        lattice.values,
        lattice.windows,
        lattice.step,
        1.0 / noise_per_m,
        gap_per_m,
        SQUARE_MOST,
        settled,
    )
    return settled


@compiled
def _spread(
    before: NDArray[np.uint16],
    on_grid: NDArray[np.int32],
    per_m: NDArray[np.float32],
    step: int,
    labels: NDArray[np.uint16],
) -> None:
    """Give the pixels of a place its label where it is another one than before."""
    height, width = before.shape
    # What the pixels of a row of places take, -1 where they keep what they have.
    taken = np.empty(width, dtype=np.int32)
    for r in range(height):
        if r % step == 0:
            for c in range(width):
                decided = on_grid[r // step, c // step]
                taken[c] = -1 if decided == before[r, c // step * step] else decided
        for c in range(width):
            label = before[r, c] if taken[c] < 0 else taken[c]
            labels[r, c] = label if per_m[r, c] > 0 else 0


@compiled
def _settle(
    labels: NDArray[np.uint16],
    per_m: NDArray[np.float32],
    values: NDArray[np.float32],
    windows: NDArray[np.int32],
    step: int,
    per_deviation: float,
    gap: float,
    square_most: float,
    settled: NDArray[np.uint16],
) -> None:
    """Write down the cheapest label of pixels at borders."""
    height, width = labels.shape
    turns, beside = np.empty(width, dtype=np.bool_), np.empty(width, dtype=np.bool_)
    candidates, costs, none = np.empty(3, dtype=np.int64), np.empty(3), 1 << 16
    for r in range(height):
        above, below = max(r - 1, 0), min(r + 2, height)
        # Most pixels have neighbours of their own label only.
        for c in range(width):
            turns[c] = (labels[above, c] != labels[r, c]) | (labels[below - 1, c] != labels[r, c])
        for c in range(1, width):
            beside[c] = (labels[r, c - 1] != labels[r, c]) | turns[c - 1] | turns[c]
        beside[0] = turns[0]
        for c in range(width):
            own = per_m[r, c]
            if not (beside[c] or beside[min(c + 1, width - 1)]) or not own > 0:
                continue
            # Its own label, the largest around, and the least; what votes for each is taken off its cost.
            candidates[0], candidates[1], candidates[2] = labels[r, c], 0, none
            left, right = max(c - 1, 0), min(c + 2, width)
            for y in range(above, below):
                for x in range(left, right):
                    near = labels[y, x]
                    if near > 0:
                        candidates[1] = max(candidates[1], near)
                        candidates[2] = min(candidates[2], near)
            if candidates[1] <= candidates[2]:
                continue
            costs[:] = 0.0
            for y in range(above, below):
                for x in range(left, right):
                    if y == r and x == c:
                        continue
                    vote = _VOTE if y == r or x == c else _DIAGONAL_VOTE
                    if not abs(per_m[y, x] - own) < gap:
                        vote *= _ACROSS_GAP
                    for n in range(3):
                        if labels[y, x] == candidates[n]:
                            costs[n] -= vote
            cheapest = np.inf
            for n in range(3):
                if candidates[n] == 0 or (n > 0 and candidates[n] == candidates[0]):
                    continue
                residual = per_deviation * (_explained(values, windows, candidates[n], r, c, step) - own)
                costs[n] += min(residual * residual, square_most)
                if costs[n] < cheapest:
                    cheapest = costs[n]
                    settled[r, c] = candidates[n]


@compiled
def _explained(
    values: NDArray[np.float32], windows: NDArray[np.int32], label: int, row: int, column: int, step: int
) -> float:
    """Return a surface's inverse depth at a pixel, linear between places; infinite beyond its reach."""
    top, left, bottom, right, start = windows[label]
    r, c = row - step * top, column - step * left
    if not (0 <= r <= step * (bottom - top - 1) and 0 <= c <= step * (right - left - 1)):
        return np.inf
    at = start + r // step * (right - left) + c // step
    # Beside the last place of a row or column no other one is asked.
    across, down = c % step / step, r % step / step
    beside, under = (1 if across > 0 else 0), (right - left if down > 0 else 0)
    upper = values[at] + across * (values[at + beside] - values[at])
    lower = values[at + under] + across * (values[at + under + beside] - values[at + under])
    return float(upper + down * (lower - upper))


__all__ = ["settled_borders", "spread_to_pixels"]
