"""Removal of small components from a cut: they go to the other side."""

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import I32, Bool, compiled

#: Neighbours of a pixel.
_CONNECTIVITY = 8


def remove_small_components(
    mask: NDArray[np.bool_], side: NDArray[np.bool_], pixels_min: float
) -> NDArray[np.bool_]:
    """Give every connected component of a side that is too small to the other side (section 3.1).

    First the True side's, then those of the new False side, so that adjacent ones are not just swapped.

    Parameters
    ----------
    mask : (h, w) bool
        Pixels of the segment that is cut.
    side : (h, w) bool
        Side of each pixel; it matters only where `mask` is set.
    pixels_min : float
        Components of fewer pixels are too small (T_p). One that does not touch the other side stays.

    Returns
    -------
    (h, w) bool
        The new side, False outside of `mask`.
    """
    side = side & mask
    for value in (False, True):
        given = mask & ~side if value else side
        _, pieces, stats, _ = cv2.connectedComponentsWithStats(
            given.view(np.uint8), connectivity=_CONNECTIVITY, ltype=cv2.CV_32S
        )
        small = stats[:, cv2.CC_STAT_AREA] < pixels_min
        small[0] = False
        if small.any():
            _give(np.asarray(pieces, dtype=np.int32), small, mask, side, value)
    return side


@compiled
def _give(
    pieces: I32,
    small: Bool,
    mask: Bool,
    side: Bool,
    value: bool,
) -> None:
    """Give small pieces of the other side to the side `value` where they touch it."""
    height, width = mask.shape
    touching = np.zeros(small.size, dtype=np.bool_)
    for row in range(height):
        for column in range(width):
            piece = pieces[row, column]
            if not small[piece] or touching[piece]:
                continue
            for r in range(max(row - 1, 0), min(row + 2, height)):
                for c in range(max(column - 1, 0), min(column + 2, width)):
                    touching[piece] |= mask[r, c] & (side[r, c] == value)
    for row in range(height):
        for column in range(width):
            if touching[pieces[row, column]]:
                side[row, column] = value
