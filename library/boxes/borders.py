"""Borders of objects: how much of them is hidden, and which pixels say how far an object goes."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I64, U16, Bool, Intp, compiled, inlined
from nurbseg.segmentation.points.registration import PointMap

#: Borders are looked at on every so many rows and columns.
_STEP = 3
#: Something is in front where its inverse depth is larger by this many times the sensor's noise.
_FRONT = 4.0
#: A pixel may be mixed where the inverse depth of one beside it is larger by so many times the noise: within
#: a row, and at its ends, where a mixture does more harm.
MIXED, MIXED_AT_ENDS = 20.0, 6.0
#: Such pixels are left out if they are no more than this share of a surface's.
MIXED_SHARE_MAX = 0.25
#: About so many ends of rows are chosen of a surface that has more.
ENDS = 60
#: An end of a row is followed inwards by so many pixels that are not mixed; what is not may lie behind.
CLEAR_MIN = 4


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
        By label, 0 to 1. Border to pixels without depth counts as seen. Border to what an object encloses, as
        a table does what stands on its middle and the shadow beside it, does not count: it is no end of the
        object.
    """
    count = int(object_of_leaf.max(initial=0)) + 1
    border = _borders(leaf_image, object_of_leaf, cloud.points_m, count, _FRONT * noise)
    return np.asarray(border[:, 1] / np.maximum(border[:, 0], 1))


@compiled
def _borders(leaf_image: U16, object_of_leaf: U16, points_m: F32, count: int, front: float) -> I64:
    """Count the border of each object, and what of it is hidden."""
    height, width = -(-leaf_image.shape[0] // _STEP), -(-leaf_image.shape[1] // _STEP)
    objects = np.zeros((height, width), dtype=np.int64)
    inverse_depth = np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            own = object_of_leaf[leaf_image[row * _STEP, column * _STEP]]
            objects[row, column] = own
            if own > 0:
                inverse_depth[row, column] = 1.0 / points_m[row * _STEP, column * _STEP, 2]
    found = np.zeros((count, 2), dtype=np.int64)
    for row in range(height):
        for column in range(width):
            own = objects[row, column]
            if row == 0:
                found[own] += 1
            if column == 0:
                found[own] += 1
            for down in range(2):
                r, c = row + down, column + 1 - down
                if r >= height or c >= width:
                    found[own] += 1
                    continue
                other = objects[r, c]
                if other == own:
                    continue
                found[own, 0] += 1
                found[other, 0] += 1
                if own == 0 or other == 0:
                    continue
                nearer = inverse_depth[r, c] - inverse_depth[row, column]
                if nearer > front:
                    found[own, 1] += 1
                elif -nearer > front:
                    found[other, 1] += 1
    # What has no depth is no object.
    found[0] = 0
    return found - _enclosed(objects, inverse_depth, found[:, 1] > 0, front)


@compiled
def _enclosed(objects: I64, inverse_depth: F64, is_hidden: Bool, front: float) -> I64:
    """Count the border of objects that are partly hidden to what they enclose, and what of it is hidden."""
    height, width = objects.shape
    ends = np.zeros((is_hidden.size, 4), dtype=np.int64)
    ends[:, :2] = height + width
    for row in range(height):
        for column in range(width):
            own = ends[objects[row, column]]
            own[0], own[2] = min(own[0], row), max(own[2], row + 1)
            own[1], own[3] = min(own[1], column), max(own[3], column + 1)
    outside = np.zeros((height, width), dtype=np.bool_)
    waiting = np.zeros((height * width, 2), dtype=np.int64)
    found = np.zeros((is_hidden.size, 2), dtype=np.int64)
    for own in range(1, is_hidden.size):
        if not is_hidden[own]:
            continue
        _mark_outside(objects, own, ends[own], outside, waiting)
        top, left, bottom, right = ends[own]
        for row in range(top + 1, bottom - 1):
            for column in range(left + 1, right - 1):
                other = objects[row, column]
                if other == own or outside[row, column]:
                    continue
                for down, across in ((1, 0), (0, 1), (-1, 0), (0, -1)):
                    r, c = row + down, column + across
                    if objects[r, c] == own:
                        is_in_front = inverse_depth[row, column] - inverse_depth[r, c] > front
                        found[own, 0] += is_in_front or other == 0
                        found[own, 1] += is_in_front
    return found


@compiled
def _mark_outside(objects: I64, own: int, ends: I64, outside: Bool, waiting: I64) -> None:
    """Mark what an object does not enclose, in the rectangle that encloses the object."""
    top, left, bottom, right = ends
    count = 0
    for row in range(top, bottom):
        for column in range(left, right):
            is_edge = row == top or column == left or row == bottom - 1 or column == right - 1
            outside[row, column] = is_edge and objects[row, column] != own
            if outside[row, column]:
                waiting[count, 0], waiting[count, 1] = row, column
                count += 1
    while count > 0:
        count -= 1
        row, column = waiting[count]
        for down, across in ((1, 0), (0, 1), (-1, 0), (0, -1)):
            r, c = row + down, column + across
            is_within = top <= r < bottom and left <= c < right
            if is_within and objects[r, c] != own and not outside[r, c]:
                outside[r, c] = True
                waiting[count, 0], waiting[count, 1] = r, c
                count += 1


def outline_pixels(pixels: NDArray[np.intp], cloud: PointMap, noise: float, step: int) -> NDArray[np.intp]:
    """Choose pixels of a surface that say how far it goes: some of all, and ends of its rows.

    Left out are pixels that may be a mixture of an object and what is behind it. At the edge of an object,
    cameras measure points between it and its background. Beside each of them, something is clearly nearer;
    so it is beside what an edge hides, which is left out, too.

    Parameters
    ----------
    pixels : (N,) intp
        Flat pixels of the image, with depth, ascending.
    cloud, noise : PointMap, float
        As for `hidden_shares`.
    step : int
        One of so many of all pixels is chosen.

    Returns
    -------
    (M,) intp
        First those at equal steps beside which nothing is clearly nearer. Then both ends of runs of pixels
        that follow each other, about `ENDS` if there are more: the outermost of four in a row, or of all,
        beside which nothing is nearer. If too many are left out at equal steps, as behind bars, none is.
    """
    depth_m = cloud.points_m.reshape(-1, 3)[:, 2]
    return _outline(pixels, depth_m, cloud.valid.shape[1], MIXED * noise, MIXED_AT_ENDS * noise, step)


@compiled
def _outline(pixels: Intp, depth_m: F32, width: int, nearer: float, at_ends: float, step: int) -> Intp:
    some, starts = -(-pixels.size // step), _starts_of_runs(pixels, width)
    runs = starts.size - 1
    found, count = np.empty(some + 2 * runs, dtype=np.intp), 0
    for n in range(0, pixels.size, step):
        if _is_clear(pixels[n], depth_m, width, nearer):
            found[count] = pixels[n]
            count += 1
    if count < (1.0 - MIXED_SHARE_MAX) * some:
        found[:some], count, at_ends = pixels[::step], some, np.inf
    # An odd step takes left and right ends in turn.
    for end in range(0, 2 * runs, (2 * runs // ENDS) | 1):
        run = pixels[starts[end // 2] : starts[end // 2 + 1]]
        found[count] = _end_of_run(run, 1 - 2 * (end % 2), depth_m, width, at_ends)
        count += found[count] >= 0
    return found[:count]


@compiled
def _starts_of_runs(pixels: Intp, width: int) -> Intp:
    """Return where runs of pixels that follow each other in a row start, and where the last one ends."""
    starts, count, row_end = np.empty(pixels.size + 1, dtype=np.intp), 0, -1
    for n in range(pixels.size):
        if pixels[n] >= row_end or pixels[n] != pixels[n - 1] + 1:
            starts[count], row_end = n, (pixels[n] // width + 1) * width
            count += 1
    starts[count] = pixels.size
    return starts[: count + 1]


@compiled
def _end_of_run(pixels: Intp, step: int, depth_m: F32, width: int, nearer: float) -> int:
    """Return the first clear pixel that others follow, inwards from the left or the right end; -1 if none."""
    clear = 0
    for pixel in pixels[::step]:
        clear = clear + 1 if _is_clear(pixel, depth_m, width, nearer) else 0
        if clear == min(CLEAR_MIN, pixels.size):
            return int(pixel - step * (clear - 1))
    return -1


@inlined
def _is_clear(pixel: int, depth_m: F32, width: int, nearer: float) -> bool:
    limit_m = depth_m[pixel] / (1.0 + nearer * depth_m[pixel])
    column = pixel % width
    for beside, is_there in (
        (pixel - width, pixel >= width),
        (pixel + width, pixel + width < depth_m.size),
        (pixel - 1, column > 0),
        (pixel + 1, column < width - 1),
    ):
        if is_there and 0.0 < depth_m[beside] < limit_m:
            return False
    return True
