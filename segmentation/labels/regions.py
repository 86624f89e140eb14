"""Connected components of labels; a gap in depth separates neighbors."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, I32, Bool, Intp, compiled
from nurbseg.segmentation.labels.images import by_label
from nurbseg.segmentation.labels.spreading import spread_labels


@dataclass(frozen=True, slots=True, eq=False)
class PixelAdjacency:
    """Which neighbors on a pixel grid have no gap in depth between them.

    Parameters
    ----------
    right : (h, w) bool
        Whether a grid pixel is connected to the one to its right; False in the last column.
    down : (h, w) bool
        Whether it is connected to the one below; False in the last row.
    """

    right: NDArray[np.bool_]
    down: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """Connected components of equal label, numbered from 1 in the order of their first grid pixels.

    Parameters
    ----------
    numbers : (h, w) int32
        Number of each grid pixel's component; 0 where the label is 0.
    labels_of : (count + 1,) int32
        Label of each component; 0 for number 0.
    small : (N,) intp
        Flat grid pixels, ascending, of components that were too small; they have no number.
    """

    numbers: NDArray[np.int32]
    labels_of: NDArray[np.int32]
    small: NDArray[np.intp]


def pixel_adjacency(
    inverse_depth: NDArray[np.float32], valid: NDArray[np.bool_], gap_per_m: float
) -> PixelAdjacency:
    """Connect neighbors whose inverse depths differ by less than a gap.

    Parameters
    ----------
    inverse_depth : (h, w) float32
        One over depth, 1/m.
    valid : (h, w) bool
        Where there is a point.
    gap_per_m : float
        Smallest gap, 1/m.

    Returns
    -------
    PixelAdjacency
        Between points only.
    """
    return PixelAdjacency(*_connect_neighbors(inverse_depth, valid, np.float32(gap_per_m)))


@compiled
def _connect_neighbors(inverse_depth: F32, valid: Bool, gap_per_m: np.float32) -> tuple[Bool, Bool]:
    height, width = valid.shape
    right, down = np.empty(valid.shape, dtype=np.bool_), np.empty(valid.shape, dtype=np.bool_)
    for row in range(height):
        for column in range(width - 1):
            step = abs(inverse_depth[row, column + 1] - inverse_depth[row, column])
            right[row, column] = (step < gap_per_m) & valid[row, column] & valid[row, column + 1]
        right[row, width - 1] = False
    for row in range(height - 1):
        for column in range(width):
            step = abs(inverse_depth[row + 1, column] - inverse_depth[row, column])
            down[row, column] = (step < gap_per_m) & valid[row, column] & valid[row + 1, column]
    down[height - 1] = False
    return right, down


def connected_components(
    labels: NDArray[np.int32], adjacency: PixelAdjacency, grid_pixels_min: float = 0.0, *, keep: int = 0
) -> Components:
    """Find the components of equal label that are connected through adjacent grid pixels.

    Parameters
    ----------
    labels : (h, w) int32
        0 belongs to no component.
    adjacency : PixelAdjacency
        Of the same grid.
    grid_pixels_min : float
        Smaller components get no number.
    keep : int
        Of labels up to this one, the largest component gets a number, however small.

    Returns
    -------
    Components
        Those that are large enough.
    """
    return _connected(_runs_in(labels, adjacency.right), adjacency.down, grid_pixels_min, keep)


def _connected(runs: I32, down: Bool, grid_pixels_min: float, keep: int) -> Components:
    numbers = np.zeros(down.shape, dtype=np.int32)
    return Components(numbers, *_connect(runs, down, grid_pixels_min, keep, numbers))


@compiled
def _runs_in(labels: I32, right: Bool) -> I32:
    """Return the runs of connected grid pixels of each row: first, one past the last, and label."""
    height, width = labels.shape
    runs, count = np.empty((labels.size, 3), dtype=np.int32), 0
    for row in range(height):
        line, linked, column = labels[row], right[row], 0
        while column < width:
            label, begin = line[column], column
            column += 1
            while column < width and line[column] == label and (label == 0 or linked[np.uint32(column - 1)]):
                column += 1
            if label > 0:
                runs[count, 0], runs[count, 1] = row * width + begin, row * width + column
                runs[count, 2] = label
                count += 1
    return runs[:count]


@compiled
def _runs_of(grid_pixels: Intp, labels: I32, right: Bool, first: int) -> I32:
    """Do what `_runs_in` does for some labeled flat grid pixels, ascending; runs count from `first` on."""
    runs, count, n = np.empty((grid_pixels.size, 3), dtype=np.int32), 0, 0
    # Nothing is connected across the ends of rows.
    linked = right.reshape(-1)
    while n < grid_pixels.size:
        last, label = np.uint32(grid_pixels[n]), labels[n]
        runs[count, 0], runs[count, 2] = last - first, label
        n += 1
        while n < grid_pixels.size and grid_pixels[n] == last + 1 and labels[n] == label and linked[last]:
            last = np.uint32(last + 1)
            n += 1
        runs[count, 1] = last + 1 - first
        count += 1
    return runs[:count]


@compiled
def _root(parents: I32, number: int) -> int:
    while parents[number] != number:
        parents[number] = parents[parents[number]]
        number = parents[number]
    return number


@compiled
def _connect(runs: I32, down: Bool, grid_pixels_min: float, keep: int, numbers: I32) -> tuple[I32, Intp]:
    """Find the components of runs; return their labels, and the grid pixels of those that are too small.

    Union-find: where two runs meet, the earlier root becomes the parent of the later one.
    """
    width, linked, number_of = down.shape[1], down.reshape(-1), numbers.reshape(-1)
    count = runs.shape[0]
    parents, size_of = np.empty(count, dtype=np.int32), np.zeros(count, dtype=np.intp)
    first = 0
    for n in range(count):
        begin, end, label = runs[n, 0] - width, runs[n, 1] - width, runs[n, 2]
        parents[n] = n
        while runs[first, 1] <= begin:
            first += 1
        above = first
        while runs[above, 0] < end:
            if runs[above, 2] == label:
                for pixel in range(max(runs[above, 0], begin), min(runs[above, 1], end)):
                    if linked[pixel]:
                        one, other = _root(parents, n), _root(parents, above)
                        parents[max(one, other)] = min(one, other)
                        break
            above += 1
    for n in range(count):
        # A parent comes earlier, so it is final already.
        parents[n] = parents[parents[n]]
        size_of[parents[n]] += runs[n, 1] - runs[n, 0]
    # The largest component of each label; of several, the last.
    largest, most = np.zeros(keep + 1, dtype=np.intp), np.zeros(keep + 1, dtype=np.intp)
    for n in range(count):
        label = runs[n, 2]
        if parents[n] == n and label <= keep and size_of[n] >= most[label]:
            largest[label], most[label] = n, size_of[n]
    labels_of, last, small = np.zeros(count + 1, dtype=np.int32), 0, 0
    for n in range(count):
        label = runs[n, 2]
        if parents[n] == n:
            if size_of[n] >= grid_pixels_min or (label <= keep and largest[label] == n):
                last += 1
                labels_of[last], size_of[n] = label, last
            else:
                small += size_of[n]
                size_of[n] = 0
    unassigned, small = np.empty(small, dtype=np.intp), 0
    for n in range(count):
        # The number of its component, from here on.
        number = size_of[parents[n]]
        for pixel in range(np.uint32(runs[n, 0]), np.uint32(runs[n, 1])):
            number_of[pixel] = number
        if number == 0:
            for pixel in range(runs[n, 0], runs[n, 1]):
                unassigned[small] = pixel
                small += 1
    return labels_of[: last + 1].copy(), unassigned


def large_components(
    grid_pixels: NDArray[np.intp],
    labels: NDArray[np.int32],
    adjacency: PixelAdjacency,
    inverse_depth: NDArray[np.float32],
    *,
    gap_per_m: float,
    grid_pixels_min: float,
) -> tuple[list[NDArray[np.intp]], list[int]]:
    """Find the connected components that are large enough, and spread them over the small ones.

    Parameters
    ----------
    grid_pixels : (N,) intp
        Flat indices of grid pixels, ascending; at least one.
    labels : (N,) int32
        Label of each, more than 0.
    adjacency, inverse_depth : PixelAdjacency, (h, w) float32
        Of the whole grid.
    gap_per_m : float
        Smallest gap, 1/m.
    grid_pixels_min : float
        Smallest number of grid pixels of a component.

    Returns
    -------
    components : list of (n,) intp
        Grid pixels of each component kept, ascending; empty if none is large enough.
    labels_of : list of int
        Label of each component.
    """
    # Only the rows that hold grid pixels are looked at.
    width = adjacency.right.shape[1]
    rows = slice(int(grid_pixels[0]) // width, int(grid_pixels[-1]) // width + 1)
    first = rows.start * width
    runs = _runs_of(grid_pixels, labels, adjacency.right, first)
    found = _connected(runs, adjacency.down[rows], grid_pixels_min, 0)
    labels_of = found.labels_of[1:].tolist()
    if not labels_of:
        return [], []
    if len(labels_of) == 1:
        return [grid_pixels], labels_of
    spread_labels(found.numbers, found.small, inverse_depth[rows], gap_per_m)
    order, bounds = by_label(found.numbers.reshape(-1), len(labels_of) + 1)
    order += first
    return [order[begin:end] for begin, end in pairwise(bounds[1:].tolist())], labels_of
