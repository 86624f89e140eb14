"""Colors for points that the color camera did not see."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

#: Pixels that a source on another, farther surface counts as being more distant.
_OTHER_SURFACE_PX = 10_000
#: Passes in which what was filled serves as a source for what is still empty.
_PASSES = 4
#: Step of the grid of sources where no pixel of the same row or column will do.
_COARSE_STEP = 16


def fill_colors(
    color: NDArray[np.uint8],
    known: NDArray[np.bool_],
    missing: NDArray[np.bool_],
    depth_m: NDArray[np.float32],
    tolerance_per_m: float,
) -> None:
    """Color each missing pixel like the nearest known one of its row or column that is not before it.

    What hides a point from the color camera stands in front of it, and so never lends it a color. A source
    at the point's own depth is taken before one on a surface farther away. Where rows and columns hold no
    source, the nearest of a coarse grid serves; if nothing lies behind, the least near one does.

    Parameters
    ----------
    color : (H, W, 3) uint8
        RGB, filled in place where `missing`.
    known : (H, W) bool
        Where `color` holds a color that may be lent.
    missing : (H, W) bool
        Where a color is wanted; apart from `known`.
    depth_m : (H, W) float32
        Metres; finite where `known` or `missing`.
    tolerance_per_m : float
        Difference of inverse depth, 1/m, up to which two points count as being of one depth.
    """
    wanted = np.flatnonzero(missing)
    if not wanted.size or not known.any():
        return
    flat_color, depth = color.reshape(-1, 3), depth_m.ravel()
    # Beside what hides them, colors are mixed with its own: such pixels lend only where nothing else can.
    beside = cv2.dilate(missing.view(np.uint8), np.ones((5, 5), np.uint8)).view(np.bool_)
    sources = (known & ~beside).ravel()
    for _ in range(_PASSES):
        source = _nearest_in_line(wanted, sources, known.shape, depth, tolerance_per_m)
        found = source >= 0
        if not found.any():
            if sources.all() or sources[np.flatnonzero(known)].all():
                break
            sources |= known.ravel()
            continue
        flat_color[wanted[found]] = flat_color[source[found]]
        sources[wanted[found]] = True
        wanted = wanted[~found]
        if not wanted.size:
            return
    _fill_from_grid(flat_color, known, wanted, depth, tolerance_per_m)


def _nearest_in_line(
    wanted: NDArray[np.intp],
    sources: NDArray[np.bool_],
    shape: tuple[int, ...],
    depth: NDArray[np.float32],
    tolerance_per_m: float,
) -> NDArray[np.intp]:
    """Return the flat index of the best source left, right, above or below each wanted pixel, or -1."""
    height, width = shape
    best = np.full(wanted.size, -1, dtype=np.intp)
    cost = np.full(wanted.size, np.inf)
    # Columns are searched as the rows of the transposed image, in whose order pixels are numbered then.
    numbered = sources.reshape(shape)
    for transposed in (False, True):
        length = height if transposed else width
        line = np.flatnonzero(numbered.T if transposed else numbered)
        place = (wanted % width) * height + wanted // width if transposed else wanted
        after = np.searchsorted(line, place)
        for position in (after - 1, after):
            candidate = line[np.clip(position, 0, line.size - 1)]
            same_line = candidate // length == place // length
            distance = np.abs(candidate - place)
            flat = (candidate % height) * width + candidate // height if transposed else candidate
            nearer = 1 / depth[flat] - 1 / depth[wanted]
            price = distance + np.where(nearer < -tolerance_per_m, _OTHER_SURFACE_PX, 0.0)
            price[~same_line | (nearer > tolerance_per_m)] = np.inf
            better = price < cost
            best[better], cost[better] = flat[better], price[better]
    return best


def _fill_from_grid(
    flat_color: NDArray[np.uint8],
    known: NDArray[np.bool_],
    wanted: NDArray[np.intp],
    depth: NDArray[np.float32],
    tolerance_per_m: float,
) -> None:
    width = known.shape[1]
    grid = np.zeros_like(known)
    grid[::_COARSE_STEP, ::_COARSE_STEP] = known[::_COARSE_STEP, ::_COARSE_STEP]
    sources = np.flatnonzero(grid if grid.any() else known)
    for chunk in np.array_split(wanted, 1 + wanted.size * sources.size // 1_000_000):
        nearer = 1 / depth[sources] - 1 / depth[chunk][:, None]
        rows = sources // width - (chunk // width)[:, None]
        columns = sources % width - (chunk % width)[:, None]
        price = np.hypot(rows, columns) + np.where(nearer < -tolerance_per_m, _OTHER_SURFACE_PX, 0.0)
        price += np.where(nearer > tolerance_per_m, 1e6 * (1.0 + nearer), 0.0)
        flat_color[chunk] = flat_color[sources[np.argmin(price, axis=1)]]
