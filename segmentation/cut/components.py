"""Removal of small components from a cut: they go to the other side."""

import cv2
import numpy as np
from numpy.typing import NDArray

#: Neighbors of a pixel.
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
        given = mask & (side != value)
        _, pieces, stats, _ = cv2.connectedComponentsWithStats(
            given.view(np.uint8), connectivity=_CONNECTIVITY, ltype=cv2.CV_32S
        )
        small = stats[:, cv2.CC_STAT_AREA] < pixels_min
        small[0] = False
        if small.any():
            other = (mask & (side == value)).view(np.uint8)
            beside = cv2.dilate(other, np.ones((3, 3), np.uint8)).astype(np.bool_)
            touching = np.zeros_like(small)
            touching[pieces[beside]] = True
            side[(small & touching)[pieces]] = value
    return side
