"""Borders of objects: how much of them is hidden, and which pixels may be mixed with what is behind."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, I64, U16, Bool, Intp, compiled
from nurbseg.segmentation.points.registration import PointMap

#: Borders are looked at on every so many rows and columns.
_STEP = 3
#: Something is in front where its inverse depth is larger by this many times the sensor's noise.
_FRONT = 4.0
#: A pixel may be mixed where the inverse depth of one beside it is larger by this many times the noise. Such
#: pixels are left out if they are no more than this share of an object's.
MIXED, MIXED_SHARE_MAX = 20.0, 0.25


def hidden_shares(
    leaf_image: NDArray[np.uint16],
    object_of_leaf: NDArray[np.uint16],
    cloud: PointMap,
    noise: float,
) -> NDArray[np.float64]:
    """Return the share of each object's border that is at an edge of the image or behind something.

    Parameters
    ----------
    leaf_image : (H, W) uint16
        Label of each pixel's leaf, 0 without depth.
    object_of_leaf : (L + 1,) uint16
        Label of each leaf's object.
    cloud : PointMap
        The frame's points.
    noise : float
        Standard deviation of the sensor's inverse depth, 1/m.

    Returns
    -------
    (N,) float64
        By label, 0 to 1. Border to pixels without depth counts as seen.
    """
    count = int(object_of_leaf.max(initial=0)) + 1
    border = _borders(leaf_image, object_of_leaf, cloud.points_m, count, _FRONT * noise)
    return np.asarray(border[:, 1] / np.maximum(border[:, 0], 1))


@compiled
def _borders(leaf_image: U16, object_of_leaf: U16, points_m: F32, count: int, front: float) -> I64:
    """Count the border of each object, and what of it is hidden."""
    height, width = leaf_image.shape
    found = np.zeros((count, 2), dtype=np.int64)
    for row in range(0, height, _STEP):
        for column in range(0, width, _STEP):
            own = object_of_leaf[leaf_image[row, column]]
            if own == 0:
                continue
            if row == 0:
                found[own] += 1
            if column == 0:
                found[own] += 1
            for down in range(2):
                r, c = row + _STEP * down, column + _STEP * (1 - down)
                if r >= height or c >= width:
                    found[own] += 1
                    continue
                other = object_of_leaf[leaf_image[r, c]]
                if other == own:
                    continue
                found[own, 0] += 1
                if other == 0:
                    continue
                found[other, 0] += 1
                nearer = 1.0 / points_m[r, c, 2] - 1.0 / points_m[row, column, 2]
                if nearer > front:
                    found[own, 1] += 1
                elif -nearer > front:
                    found[other, 1] += 1
    return found


def unmixed(pixels: NDArray[np.intp], cloud: PointMap, noise: float) -> NDArray[np.intp]:
    """Leave out pixels that may be a mixture of an object and what is behind it.

    At the edge of an object, cameras measure points between it and its background. Beside each of them,
    something is clearly nearer; so it is beside what an edge hides, which is left out, too.

    Parameters
    ----------
    pixels : (N,) intp
        Flat pixels of the image, with depth.
    cloud, noise : PointMap, float
        As for `hidden_shares`.

    Returns
    -------
    (M,) intp
        Those beside which nothing is clearly nearer; all if they are too few, as behind bars.
    """
    found = pixels[_unmixed(pixels, cloud.points_m, MIXED * noise)]
    return found if found.size >= (1.0 - MIXED_SHARE_MAX) * pixels.size else pixels


@compiled
def _unmixed(pixels: Intp, points_m: F32, nearer: float) -> Bool:
    height, width = points_m.shape[:2]
    found = np.ones(pixels.size, dtype=np.bool_)
    for n in range(pixels.size):
        row, column = pixels[n] // width, pixels[n] % width
        limit = 1.0 / points_m[row, column, 2] + nearer
        for down, across in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            r, c = row + down, column + across
            if 0 <= r < height and 0 <= c < width and points_m[r, c, 2] > 0.0:
                found[n] &= 1.0 / points_m[r, c, 2] <= limit
    return found
