"""Sets of grid pixels as runs: successive pixels of a row, in the order of rows."""

import numpy as np

from nurbseg.common.compiled import I32, I64, Intp, compiled

#: Columns of the table of sets: where the runs of a set begin, and one past the last.
BEGIN, END = 0, 1


@compiled
def runs_of_labels(labels: I32, number_of: I64, sets: I64, first: int, runs: I32, used: int) -> int:
    """Find the runs of all labels of an image.

    Parameters
    ----------
    labels : (h, w) int32
        0 belongs to no set.
    number_of : (N,) int64
        Number of the set of each label, counted from 1; 0 for none.
    sets : (N, >= 2) int64
        Table of sets, whose rows from `first` on are filled in: ``BEGIN`` and ``END``.
    first : int
        Row of the set of number 1.
    runs : (M, 3) int32
        Row, first column and one past the last; filled in from `used` on, a row for each pixel at most.
    used : int
        Number of runs that there are.

    Returns
    -------
    int
        Number of runs that there are now.
    """
    height, width = labels.shape
    scanned, found = np.empty((labels.size, 4), dtype=np.int32), 0
    count = number_of.max()
    sets[first : first + count, END] = 0
    for row in range(height):
        column = 0
        while column < width:
            label, begin = labels[row, column], column
            column += 1
            while column < width and labels[row, column] == label:
                column += 1
            if label > 0 and number_of[label] > 0:
                scanned[found, 0], scanned[found, 1], scanned[found, 2] = row, begin, column
                scanned[found, 3] = first + number_of[label] - 1
                sets[scanned[found, 3], END] += 1
                found += 1
    # Sorted by counting; the order of rows remains.
    for number in range(first, first + count):
        size = sets[number, END]
        sets[number, BEGIN] = sets[number, END] = used
        used += size
    for n in range(found):
        at = sets[scanned[n, 3], END]
        for k in range(3):
            runs[at, k] = scanned[n, k]
        sets[scanned[n, 3], END] = at + 1
    return used


@compiled
def runs_of_pixels(
    grid_pixels: Intp, bounds: I64, width: int, sets: I64, first: int, runs: I32, used: int
) -> int:
    """Find the runs of lists of flat grid pixels, each ascending, which begin and end at `bounds`."""
    for part in range(bounds.size - 1):
        n, end = bounds[part], bounds[part + 1]
        sets[first + part, BEGIN] = used
        while n < end:
            pixel, begin = grid_pixels[n], n
            row = pixel // width
            last = min(n + (row + 1) * width - pixel, end)
            n += 1
            while n < last and grid_pixels[np.uint32(n)] == pixel + n - begin:
                n += 1
            column = pixel - row * width
            runs[used, 0], runs[used, 1], runs[used, 2] = row, column, column + n - begin
            used += 1
        sets[first + part, END] = used
    return used


@compiled
def runs_of_union(members: I64, height: int, sets: I64, number: int, runs: I32, used: int) -> int:
    """Join the runs of sets that share no pixel, and make of all the set of a number."""
    starts, total = np.zeros(height + 1, dtype=np.int64), 0
    for m in members:
        total += sets[m, END] - sets[m, BEGIN]
        for k in range(sets[m, BEGIN], sets[m, END]):
            starts[runs[k, 0] + 1] += 1
    for row in range(height):
        starts[row + 1] += starts[row]
    ends, sides = starts.copy(), np.empty((total, 2), dtype=np.int32)
    for m in members:
        for k in range(sets[m, BEGIN], sets[m, END]):
            row = runs[k, 0]
            n = ends[row]
            ends[row] = n + 1
            while n > starts[row] and sides[n - 1, 0] > runs[k, 1]:
                sides[n, 0], sides[n, 1] = sides[n - 1, 0], sides[n - 1, 1]
                n -= 1
            sides[n, 0], sides[n, 1] = runs[k, 1], runs[k, 2]
    sets[number, BEGIN] = used
    for row in range(height):
        for n in range(starts[row], starts[row + 1]):
            if n > starts[row] and sides[n, 0] == runs[used - 1, 2]:
                runs[used - 1, 2] = sides[n, 1]
            else:
                runs[used, 0], runs[used, 1], runs[used, 2] = row, sides[n, 0], sides[n, 1]
                used += 1
    sets[number, END] = used
    return used
