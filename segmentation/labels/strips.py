"""Strips along the borders of two labels: the places of either one that are near the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled
from nurbseg.segmentation.points.grid import Window


class BorderStrips:
    """Finds the strips of an image of labels.

    Parameters
    ----------
    labels : (h, w) int32
        0 is no label.
    """

    def __init__(self, labels: NDArray[np.int32]) -> None:
        self._labels = np.ascontiguousarray(labels)
        self._extents = np.zeros((int(labels.max(initial=0)) + 1, 4), dtype=np.int32)
        _find_extents(self._labels, self._extents)
        self._marks = np.empty(labels.shape, dtype=np.uint8)

    def strip(self, first: int, second: int, reach: int) -> tuple[Window, NDArray[np.uint8]]:
        """Find the places of either label with the other one within reach.

        Parameters
        ----------
        first, second : int
            Labels, more than 0.
        reach : int
            How far along rows and along columns, places.

        Returns
        -------
        window : (int, int, int, int)
            First row and column of the strip, and one past the last of each.
        strip : (rows, columns) uint8
            1 and 2 where it is in the first and the second label, else 0. Empty where there is no strip.
        """
        if max(first, second) >= len(self._extents):
            return (0, 0, 0, 0), self._marks[:0, :0]
        window = _mark(self._labels, self._extents, first, second, reach, self._marks)
        return window, self._marks[window[0] : window[2], window[1] : window[3]].copy()


@compiled
def _find_extents(labels: NDArray[np.int32], extents: NDArray[np.int32]) -> None:
    """Find the window of each label: first row and column, one past the last of each; all 0 for none."""
    height, width = labels.shape
    for row in range(height):
        for column in range(width):
            window = extents[labels[row, column]]
            if window[2] == 0:
                window[0], window[1] = row, column
            window[1], window[3] = min(window[1], column), max(window[3], column + 1)
            window[2] = row + 1


@compiled
def _mark(
    labels: NDArray[np.int32],
    extents: NDArray[np.int32],
    first: int,
    second: int,
    reach: int,
    marks: NDArray[np.uint8],
) -> tuple[int, int, int, int]:
    """Mark a strip within its window, and return that.

    On the way bits 0 and 1 say that the first and second label are near along the row, 2 and 3 that such a
    place is near along the column.
    """
    height, width = labels.shape
    one, other = extents[first], extents[second]
    # Where both labels, each grown by the reach, can be.
    top, bottom = max(one[0], other[0]) - reach, min(one[2], other[2]) + reach
    left, right = max(one[1], other[1]) - reach, min(one[3], other[3]) + reach
    top, left, bottom, right = max(top, 0), max(left, 0), min(bottom, height), min(right, width)
    if one[2] == 0 or other[2] == 0 or top >= bottom or left >= right:
        return 0, 0, 0, 0

    for row in range(top, bottom):
        last_first = last_second = left - reach - 1
        for column in range(left, right):
            label = labels[row, column]
            if label == first:
                last_first = column
            elif label == second:
                last_second = column
            marks[row, column] = (column - last_first <= reach) | (column - last_second <= reach) << 1
        last_first = last_second = right + reach
        for column in range(right - 1, left - 1, -1):
            label = labels[row, column]
            if label == first:
                last_first = column
            elif label == second:
                last_second = column
            marks[row, column] |= (last_first - column <= reach) | (last_second - column <= reach) << 1

    lasts = np.full((2, width), top - reach - 1)
    for row in range(top, bottom):
        for column in range(left, right):
            for side in range(2):
                if marks[row, column] >> side & 1:
                    lasts[side, column] = row
                if row - lasts[side, column] <= reach:
                    marks[row, column] |= 4 << side
    lasts[:] = bottom + reach
    window_top, window_left, window_bottom, window_right = bottom, right, top, left
    for row in range(bottom - 1, top - 1, -1):
        for column in range(left, right):
            for side in range(2):
                if marks[row, column] >> side & 1:
                    lasts[side, column] = row
                if lasts[side, column] - row <= reach:
                    marks[row, column] |= 4 << side
            label, near = labels[row, column], marks[row, column]
            mark = 1 if label == first and near & 8 else 2 if label == second and near & 4 else 0
            marks[row, column] = mark
            if mark > 0:
                window_top, window_bottom = row, max(window_bottom, row + 1)
                window_left, window_right = min(window_left, column), max(window_right, column + 1)
    if window_top == bottom:
        return 0, 0, 0, 0
    return window_top, window_left, window_bottom, window_right


__all__ = ["BorderStrips"]
