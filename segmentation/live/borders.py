"""Labels of every pixel, from those on the grid and those of the pixels before."""

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F32, I32, U16, Bool, compiled, inlined_once
from nurbseg.segmentation.extended.borders import ACROSS_GAP, Deviations
from nurbseg.segmentation.surfaces.lattice import Samples, SurfaceLattice
from nurbseg.segmentation.surfaces.metrics import SQUARE_MOST

#: Vote of a pixel by its number of nonzero offsets: for itself, beside, and diagonally.
_VOTES = np.array([0.0, 1.4, 1.4 / 2**0.5])
#: Sweeps over the pixels at borders in one frame: one does not keep up with moving things.
_SWEEPS = 2


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
    size, shape = (step * on_grid.shape[1], step * on_grid.shape[0]), before.shape
    changed = (on_grid != before[::step, ::step]).view(np.uint8)
    labels = before.copy()
    cells, taken = (
        cv2.resize(each, size, interpolation=cv2.INTER_NEAREST)[: shape[0], : shape[1]]
        for each in (on_grid.astype(np.uint16), changed)
    )
    np.copyto(labels, cells, where=taken > 0)
    labels *= inverse_depth > 0
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

    Sweeps of iterated conditional modes, as in `refine_borders`; later frames continue them.

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
    _relax(relaxed, inverse_depth, lattice.samples, lattice.step, deviations, gap_per_m, _SWEEPS)
    return relaxed


@compiled
def _relax(
    labels: U16,
    inverse_depth: F32,
    samples: Samples,
    step: int,
    deviations: Deviations,
    gap: float,
    sweeps: int,
) -> None:
    pixels, beside = np.empty((2, labels.size, 2), dtype=np.int32)
    best, listed = np.empty(labels.size, dtype=np.uint16), np.zeros(labels.shape, dtype=np.bool_)
    count = _find_borders(labels, inverse_depth, pixels)
    for _ in range(sweeps):
        _judge(labels, inverse_depth, pixels, count, samples, step, deviations, gap, best)
        # Only beside a pixel that has changed can another label be the cheapest now.
        around = 0
        for n in range(count):
            row, column = pixels[n]
            if best[n] != labels[row, column]:
                labels[row, column] = best[n]
                around = _list_around((row, column), inverse_depth, listed, beside, around)
        for n in range(around):
            listed[beside[n, 0], beside[n, 1]] = False
        pixels, beside, count = beside, pixels, around


@inlined_once
def _find_borders(labels: U16, inverse_depth: F32, pixels: I32) -> int:
    """List the rows and columns of pixels with a point that have neighbours of another label; count them."""
    height, width = labels.shape
    turns, beside = np.empty(width, dtype=np.bool_), np.empty(width, dtype=np.bool_)
    count = 0
    for r in range(height):
        above, below = max(r - 1, 0), min(r + 1, height - 1)
        # Most pixels have only neighbours of their own label.
        for c in range(width):
            turns[c] = (labels[above, c] != labels[r, c]) | (labels[below, c] != labels[r, c])
        for c in range(1, width):
            beside[c] = (labels[r, c - 1] != labels[r, c]) | turns[c - 1] | turns[c]
        beside[0] = turns[0]
        for c in range(width):
            if (beside[c] or beside[min(c + 1, width - 1)]) and inverse_depth[r, c] > 0:
                pixels[count, 0], pixels[count, 1] = r, c
                count += 1
    return count


@inlined_once
def _list_around(pixel: tuple[int, int], inverse_depth: F32, listed: Bool, pixels: I32, count: int) -> int:
    """Add a pixel and its neighbours that have a point, each once, to a list of so many; count them."""
    height, width = inverse_depth.shape
    row, column = pixel
    for r in range(max(row - 1, 0), min(row + 2, height)):
        for c in range(max(column - 1, 0), min(column + 2, width)):
            if not listed[r, c] and inverse_depth[r, c] > 0:
                listed[r, c] = True
                pixels[count, 0], pixels[count, 1] = r, c
                count += 1
    return count


@inlined_once
def _judge(
    labels: U16,
    inverse_depth: F32,
    pixels: I32,
    count: int,
    samples: Samples,
    step: int,
    deviations: Deviations,
    gap: float,
    best: U16,
) -> None:
    """Find the cheapest of each pixel's label, the largest and the least around it.

    Surfaces are linear between grid pixels, and are not extrapolated beyond their last row and column.
    """
    # Nothing is taken out of a tuple in the loop, nor handed to a function: both would count references to
    # arrays at each pixel, which would take most of the time.
    values, windows = samples
    precision_m, penalty = deviations
    height, width = labels.shape
    for n in range(count):
        r, c = pixels[n, 0], pixels[n, 1]
        own = inverse_depth[r, c]
        above, below = max(r - 1, 0), min(r + 2, height)
        left, right = max(c - 1, 0), min(c + 2, width)
        before, most, least = np.int64(labels[r, c]), np.int64(0), np.int64(1 << 16)
        for y in range(above, below):
            for x in range(left, right):
                near = np.int64(labels[y, x])
                most = near if near > most else most
                least = near if 0 < near < least else least
        best[n] = before
        if most <= least:
            continue
        for_before, for_most, for_least = 0.0, 0.0, 0.0
        for y in range(above, below):
            for x in range(left, right):
                near, vote = np.int64(labels[y, x]), _VOTES[(y != r) + (x != c)]
                vote *= 1.0 if abs(inverse_depth[y, x] - own) < gap else ACROSS_GAP
                for_before += vote if near == before else 0.0
                for_most += vote if near == most else 0.0
                for_least += vote if near == least else 0.0
        row, column = r // step, c // step
        down, across = (r - step * row) / step, (c - step * column) / step
        under, beside = (1 if down > 0 else 0), (1 if across > 0 else 0)
        cheapest = np.inf
        for label, vote in ((before, for_before), (most, for_most), (least, for_least)):
            if label == 0 or (label == before and cheapest < np.inf):
                continue
            first_row, first_column = windows[label, 0], windows[label, 1]
            end_row, end_column = windows[label, 2], windows[label, 3]
            square = SQUARE_MOST
            if first_row <= row < end_row - under and first_column <= column < end_column - beside:
                wide = end_column - first_column
                at = windows[label, 4] + (row - first_row) * wide + column - first_column
                upper = values[at] + across * (values[at + beside] - values[at])
                at += under * wide
                lower = values[at] + across * (values[at + beside] - values[at])
                residual = precision_m[label] * (float(upper + down * (lower - upper)) - own)
                square = min(residual * residual, SQUARE_MOST)
            cost = square + penalty[label] - vote
            if cost < cheapest:
                cheapest, best[n] = cost, label
