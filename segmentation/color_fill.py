"""Colors for points that the color camera did not see."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

#: Pixels that a source on another, farther surface counts as being more distant.
_OTHER_SURFACE_PX = 10_000
#: Passes in which what was filled serves as a source for what is still empty.
_PASSES = 4
#: How many sources are looked at where no pixel of the same row or column will do.
_LAST_RESORT = 4000


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
    source, the next in depth serves wherever it is; if nothing lies behind, the farthest does.

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
    everything = False
    for _ in range(_PASSES):
        source = _nearest_in_line(wanted, sources, known.shape, depth, tolerance_per_m)
        found = source >= 0
        if not found.any():
            if everything:
                break
            sources |= known.ravel()
            everything = True
            continue
        flat_color[wanted[found]] = flat_color[source[found]]
        sources[wanted[found]] = True
        wanted = wanted[~found]
        if not wanted.size:
            return
    # Neither row nor column holds anything: what is nearest in depth from there on, or the farthest at all.
    some = np.flatnonzero(known)
    some = some[:: max(some.size // _LAST_RESORT, 1)]
    some = some[np.argsort(depth[some])]
    behind = np.searchsorted(depth[some], depth[wanted])
    flat_color[wanted] = flat_color[some[np.minimum(behind, some.size - 1)]]


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
        if not line.size:
            continue
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
