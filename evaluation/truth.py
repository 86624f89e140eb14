"""The ground truth that frames are scored against: as labeled, or with the pieces of an object joined."""

from collections.abc import Mapping
from itertools import combinations
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import DisjointSet

Truth = Literal["labels", "joined"]

#: What reports say of each.
TRUTHS: Mapping[Truth, str] = {
    "labels": "Ground truth: the regions as labeled",
    "joined": "Ground truth: the labels, with pieces of one object that meet in the image joined",
}

#: Labels of an object differ in their last digit in OSD and MOSD, if nothing else is given.
_PIECES = 10
#: Pieces meet if they are as close as this, pixels, along a border with more than this number of pixels.
_REACH_PX, _BORDER_PIXELS_MIN = 7, 100
#: Greatest number of pixels of other regions between two pieces that meet, for each pixel of their own.
_BETWEEN_MAX = 0.5


def ground_truth(labels: NDArray[np.uint16], truth: Truth, pieces: int = 1) -> NDArray[np.uint16]:
    """Return the regions that a frame is scored against.

    Parameters
    ----------
    labels : (H, W) uint16
        Regions as labeled; 0 is none.
    truth : Truth
        ``labels`` returns them unchanged. With ``joined``, pieces of one object that meet in the image
        become one region, so that it does not matter whether somebody labeled the inside and the outside of
        a bowl as two regions or one.
    pieces : int
        A label divided by this, rounded down, is the object, and 0 is the background, whose labels remain.
        1 stands for the 10 of OSD and MOSD.

    Returns
    -------
    (H, W) uint16
        Joined regions have the least of their labels.
    """
    if truth == "labels":
        return labels
    pieces = _PIECES if pieces == 1 else pieces
    values = [int(label) for label in np.unique(labels) if label >= pieces]
    joined = DisjointSet(values)
    around = {value: _surroundings(labels == value) for value in values}
    for one, other in combinations(values, 2):
        if one // pieces == other // pieces and _meet(labels, one, other, around[one], around[other]):
            joined.merge(one, other)
    regions = labels.copy()
    for region in joined.subsets():
        regions[np.isin(labels, list(region))] = min(region)
    return regions


def _surroundings(region: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels of a region and those near it, by rows and columns."""
    window = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), np.uint8)
    return np.asarray(cv2.dilate(region.astype(np.uint8), window) > 0)


def _meet(
    labels: NDArray[np.uint16],
    one: int,
    other: int,
    around_one: NDArray[np.bool_],
    around_other: NDArray[np.bool_],
) -> bool:
    """Whether two pieces are close along a border, and not separated by a third region."""
    border = min(
        np.count_nonzero(around_one & (labels == other)), np.count_nonzero(around_other & (labels == one))
    )
    between = labels[around_one & around_other]
    own = np.count_nonzero((between == one) | (between == other))
    return bool(border > _BORDER_PIXELS_MIN and np.count_nonzero(between) - own < _BETWEEN_MAX * own)
