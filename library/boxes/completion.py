"""What of an object's box is not seen: down to what it stands on, and behind a rounded top."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.boxes.support import Support

#: An object reaches down to the support where no more than this is missing: meters, and share of its height.
_MISSING_M, _MISSING_SHARE = 0.015, 0.3
#: How far below a level plane the lowest points of what stands on it may lie, meters.
_BELOW_M = 0.01
#: A side that ends this much lower than the top, as shares of the height, is rounded, and ends in the air.
_ROUNDED = (0.2, 0.93)
#: A side is made longer by this share of what is seen of it at most.
LONGER_MAX = 0.6


def standing(support: Support, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lower ends of boxes, brought down to what they stand on if little is missing.

    Parameters
    ----------
    support : Support
        With the level planes of the frame.
    low, high : (M,) float64
        The ends of the boxes along the vertical, meters from the camera.

    Returns
    -------
    (M,) float64
        As `low`.
    """
    bottom, top = low + support.camera_height_m, high + support.camera_height_m
    place = np.searchsorted(support.levels_m, bottom + _BELOW_M, side="right") - 1
    level = support.levels_m[place.clip(0)]
    missing = bottom - level
    stands = missing <= np.maximum(_MISSING_M, _MISSING_SHARE * (top - level))
    # What is as flat as the plane itself stays as it is.
    stands &= (place >= 0) & (top - level > 2 * _BELOW_M)
    return np.where(stands, np.minimum(level, bottom) - support.camera_height_m, low)


def with_far_sides(
    axes: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    profile: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ends of boxes, farther away where a rounded top hides the far side.

    Where a side ends in the air behind the top, but lower than it, as with balls and cushions, the far half
    is taken to be like the near one.

    Parameters
    ----------
    axes, low, high, profile : ndarray
        As `nurbseg.library.boxes.boxes.box_ends` returns them; `low` reaches down to what objects stand on.

    Returns
    -------
    low, high : (M, 3) float64
        The ends, meters from the camera.
    """
    low, high = low.copy(), high.copy()
    height = np.maximum(high[:, 2] - low[:, 2], 1e-9)
    for side in range(2):
        seen = high[:, side] - low[:, side]
        # The camera is at 0: an end is the far one if it is farther along the side.
        is_far_high = (low[:, side] + high[:, side]) > 0
        end = np.where(is_far_high, profile[:, side, 1], profile[:, side, 0])
        share = (end - low[:, 2]) / height
        rounded = (share > _ROUNDED[0]) & (share < _ROUNDED[1])
        top = profile[:, side, 2]
        near = np.where(is_far_high, low[:, side], high[:, side])
        more = np.abs(2 * top - near - np.where(is_far_high, high[:, side], low[:, side]))
        beyond = np.where(is_far_high, 2 * top - near > high[:, side], 2 * top - near < low[:, side])
        more = np.where(rounded & beyond, np.minimum(more, LONGER_MAX * seen), 0.0)
        high[:, side] += np.where(is_far_high, more, 0.0)
        low[:, side] -= np.where(is_far_high, 0.0, more)
    return low, high
