"""Colors for points that the color camera did not see."""

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, U8, Bool, Intp, compiled

#: Added to the distance of a source on a farther surface, pixels.
_OTHER_SURFACE_PX = 10_000
#: Passes; pixels that were filled in one are sources in the next.
_PASSES = 4
#: Number of sources to choose from, about, where no pixel of the same row or column will do.
_FALLBACK_SOURCES = 4000


def fill_colors(
    color: NDArray[np.uint8],
    known: NDArray[np.bool_],
    missing: NDArray[np.bool_],
    depth_m: NDArray[np.float32],
    tolerance_per_m: float,
) -> None:
    """Color each missing pixel like the nearest known one in its row or column that is not in front of it.

    What hides a point from the color camera is in front of it, so its color is never taken. Sources at the
    point's own depth are preferred to farther ones. Where row and column hold none, the known pixel that is
    next behind in depth serves, or else the farthest.

    Parameters
    ----------
    color : (H, W, 3) uint8
        RGB, filled in place where `missing`.
    known : (H, W) bool
        Where `color` may be taken from.
    missing : (H, W) bool
        Where a color is wanted; disjoint from `known`.
    depth_m : (H, W) float32
        Meters; finite where `known` or `missing`.
    tolerance_per_m : float
        Largest difference of inverse depth of points at the same depth, 1/m.
    """
    if not missing.any() or not known.any():
        return
    # Next to missing pixels the color of the hiding object is mixed in: these sources come last.
    beside = cv2.dilate(missing.view(np.uint8), np.ones((5, 5), np.uint8)).view(np.bool_)
    sources = known & ~beside
    wanted = np.flatnonzero(missing)
    everything = False
    for _ in range(_PASSES):
        left = _fill_along_lines(color, sources, wanted, depth_m, tolerance_per_m)
        if left.size == wanted.size:
            if everything:
                break
            sources |= known
            everything = True
        wanted = left
        if not wanted.size:
            return
    flat_color, depth, some = color.reshape(-1, 3), depth_m.ravel(), np.flatnonzero(known)
    some = some[:: max(some.size // _FALLBACK_SOURCES, 1)]
    some = some[np.argsort(depth[some])]
    behind = np.searchsorted(depth[some], depth[wanted])
    flat_color[wanted] = flat_color[some[np.minimum(behind, some.size - 1)]]


@compiled
def _fill_along_lines(color: U8, sources: Bool, wanted: Intp, depth_m: F32, tolerance_per_m: float) -> Intp:
    """Color wanted pixels, ascending, from the best source left, right, above or below.

    These become sources too. Returns those without a source.
    """
    height, width = sources.shape
    # The nearest source in each direction, a flat index or -1, found by sweeping down and up.
    nearest = np.full((4, wanted.size), -1, dtype=np.intp)
    column_source = np.empty(width, dtype=np.intp)
    for step in (1, -1):
        column_source[:] = -1
        n, along = (0, 0) if step > 0 else (wanted.size - 1, 1)
        for k in range(height):
            if not 0 <= n < wanted.size:
                break
            row, row_source = k if step > 0 else height - 1 - k, -1
            begin = row * width
            if not begin <= wanted[n] < begin + width:
                for column in range(width):
                    column_source[column] = begin + column if sources[row, column] else column_source[column]
                continue
            for m in range(width):
                column = m if step > 0 else width - 1 - m
                if sources[row, column]:
                    row_source = column_source[column] = begin + column
                if 0 <= n < wanted.size and wanted[n] == begin + column:
                    nearest[along, n], nearest[2 + along, n] = row_source, column_source[column]
                    n += step
    flat_color, source = color.reshape(-1, 3), sources.reshape(-1)
    left = np.empty(wanted.size, dtype=np.intp)
    count = 0
    for n in range(wanted.size):
        pixel = wanted[n]
        best, cost, near = -1, np.inf, 1.0 / depth_m[pixel // width, pixel % width]
        for direction in range(4):
            candidate = nearest[direction, n]
            if candidate < 0:
                continue
            nearer = 1.0 / depth_m[candidate // width, candidate % width] - near
            if nearer > tolerance_per_m:
                continue
            price = abs(candidate - pixel) / (1.0 if direction < 2 else width)
            price += _OTHER_SURFACE_PX if nearer < -tolerance_per_m else 0.0
            if price < cost:
                best, cost = candidate, price
        if best < 0:
            left[count] = pixel
            count += 1
        else:
            for channel in range(3):
                flat_color[pixel, channel] = flat_color[best, channel]
            source[pixel] = True
    return left[:count].copy()
