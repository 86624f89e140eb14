"""Labels spread to unlabeled pixels from their neighbors."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, I32, Intp, compiled

#: Marks of grid pixels to label, in an image of labels: those waiting, and those next.
_OPEN, _NEXT = -1, -2
#: Offsets of the neighbors; of equally near ones the first gives its label.
_NEIGHBORS = ((0, 1), (1, 0), (0, -1), (-1, 0))


def spread_labels(
    labels: NDArray[np.int32],
    grid_pixels: NDArray[np.intp],
    inverse_depth: NDArray[np.float32],
    gap_per_m: float,
) -> None:
    """Give unlabeled pixels the label of the neighbor nearest in inverse depth, from the border inward.

    Parameters
    ----------
    labels : (h, w) int32
        Changed; contiguous. 0 is no label. Without any label, nothing is labeled.
    grid_pixels : (N,) intp
        Flat indices of the grid pixels to label. Those not connected to a label take that of the nearest
        labeled grid pixel.
    inverse_depth : (h, w) float32
        One over depth, 1/m.
    gap_per_m : float
        Smallest gap, 1/m; labels cross gaps only where there is no other way.
    """
    if grid_pixels.size == 0:
        return
    waiting = grid_pixels.copy()
    labels.reshape(-1)[waiting] = _OPEN
    islands = _spread(labels, inverse_depth, waiting, np.float32(gap_per_m))
    if islands:
        _take_nearest(labels, waiting[:islands])


@compiled
def _spread(labels: I32, inverse_depth: F32, grid_pixels: Intp, gap_per_m: np.float32) -> int:
    """Label open pixels in rounds; move those that stay open to the front, and return how many they are."""
    height, width = labels.shape
    flat = labels.reshape(-1)
    front, reached = grid_pixels.copy(), np.empty_like(grid_pixels)
    taken = np.empty(grid_pixels.size, dtype=np.int32)
    waiting, fronts = grid_pixels.size, grid_pixels.size
    limit = gap_per_m
    while True:
        count = 0
        for n in range(fronts):
            row, column = front[n] // width, front[n] % width
            least, nearest = limit, np.int32(0)
            for down, across in _NEIGHBORS:
                r, c = row + down, column + across
                if 0 <= r < height and 0 <= c < width and labels[r, c] > 0:
                    step = abs(inverse_depth[r, c] - inverse_depth[row, column])
                    if step < least:
                        least, nearest = step, labels[r, c]
            flat[front[n]] = _OPEN
            if nearest > 0:
                reached[count], taken[count] = front[n], nearest
                count += 1
        fronts = 0
        if count == 0:
            for n in range(waiting):
                if flat[grid_pixels[n]] < 0:
                    grid_pixels[fronts] = front[fronts] = grid_pixels[n]
                    fronts += 1
            waiting = fronts
            if waiting == 0 or limit == np.float32(np.inf):
                return waiting
            limit = np.float32(np.inf)
            continue
        limit = gap_per_m
        for n in range(count):
            flat[reached[n]] = taken[n]
        for n in range(count):
            row, column = reached[n] // width, reached[n] % width
            for down, across in _NEIGHBORS:
                r, c = row + down, column + across
                if 0 <= r < height and 0 <= c < width and labels[r, c] == _OPEN:
                    labels[r, c] = _NEXT
                    front[fronts] = r * width + c
                    fronts += 1


@compiled
def _nearest_along(column: I32, along: I32) -> None:
    """Find how far the nearest label of a column is from each row; see `_take_nearest`."""
    height, last = column.size, column.size
    for row in range(height):
        if column[row] > 0:
            last = 0
        elif last != height:
            last -= 1
        along[row] = last
    for row in range(height - 2, -1, -1):
        below = along[row + 1] + 1
        if 0 < below < abs(along[row]):
            along[row] = below


@compiled
def _take_nearest(labels: I32, islands: Intp) -> None:
    """Give open pixels the label of the nearest labeled pixel, 0 where there is none."""
    height, width = labels.shape
    # How far the nearest label of the same column is, upward less than 0; `height` where there is none. Found
    # for a column when it is asked for: most islands are few pixels near labels.
    along, is_found = np.empty((width, height), dtype=np.int32), np.zeros(width, dtype=np.bool_)
    nearest = np.zeros(islands.size, dtype=np.int32)
    for n in range(islands.size):
        row, column = islands[n] // width, islands[n] % width
        least = height * height + width * width
        for apart in range(width):
            if apart * apart >= least or (apart > column and column + apart >= width):
                break
            for other in (column - apart, column + apart):
                if not 0 <= other < width:
                    continue
                if not is_found[other]:
                    is_found[other] = True
                    _nearest_along(labels[:, other], along[other])
                down = along[other, row]
                if abs(down) < height and apart * apart + down * down < least:
                    least = apart * apart + down * down
                    nearest[n] = labels[row + down, other]
    flat = labels.reshape(-1)
    for n in range(islands.size):
        flat[islands[n]] = nearest[n]
