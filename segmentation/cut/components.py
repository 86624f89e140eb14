"""Clean-up of a cut: connected pieces that are too small go to the other side."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_CONNECTIVITY = 8


def remove_small_components(
    mask: NDArray[np.bool_], side: NDArray[np.bool_], pixels_min: float
) -> NDArray[np.bool_]:
    """Give every connected piece of a side that is too small to the other side (section 3.1).

    First the small pieces of the True side go, then those of what the False side is by then, so that
    specks of both sides in the same place do not just change places.

    Parameters
    ----------
    mask : (h, w) bool
        Pixels of the segment that is cut.
    side : (h, w) bool
        Side of each pixel; it matters only where `mask` is set.
    pixels_min : float
        Pieces of fewer pixels are too small (T_p). A piece that does not touch the other side stays: it
        is an island, and no less an island on the other side.

    Returns
    -------
    (h, w) bool
        The new side, False outside of `mask`.
    """
    side = side & mask
    side &= ~_small_pieces(side, mask & ~side, pixels_min)
    side |= _small_pieces(mask & ~side, side, pixels_min)
    return side


def _small_pieces(
    region: NDArray[np.bool_], other: NDArray[np.bool_], pixels_min: float
) -> NDArray[np.bool_]:
    """Find the pieces of `region` with fewer than `pixels_min` pixels that touch `other`."""
    count, pieces, stats, _ = cv2.connectedComponentsWithStats(
        region.view(np.uint8), connectivity=_CONNECTIVITY, ltype=cv2.CV_32S
    )
    small = stats[:, cv2.CC_STAT_AREA] < pixels_min
    small[0] = False
    if not small.any():
        return np.zeros(region.shape, dtype=np.bool_)
    near = cv2.dilate(other.view(np.uint8), np.ones((3, 3), dtype=np.uint8))
    touching = np.zeros(count, dtype=np.bool_)
    touching[pieces[near.view(np.bool_)]] = True
    found: NDArray[np.bool_] = (small & touching)[pieces]
    return found


__all__ = ["remove_small_components"]
