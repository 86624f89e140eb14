"""Strips along the borders of two labels: the grid pixels of either one that are near the other."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.labels.boxes import bounding_boxes
from nurbseg.segmentation.points.grid import Window


class BorderStrips:
    """Finds the strips of an image of labels.

    Parameters
    ----------
    labels : (h, w) int32
        0 is no label.
    """

    def __init__(self, labels: NDArray[np.int32]) -> None:
        self._labels = labels
        self._boxes = bounding_boxes(labels.astype(np.uint16), int(labels.max(initial=0)) + 1)

    def strip(self, first: int, second: int, reach: int) -> tuple[Window, NDArray[np.uint8]]:
        """Find the grid pixels of either label with the other one within reach.

        Parameters
        ----------
        first, second : int
            Labels, more than 0.
        reach : int
            How far along rows and along columns, grid pixels.

        Returns
        -------
        window : (int, int, int, int)
            First row and column of the strip, and one past the last of each.
        strip : (rows, columns) uint8
            1 and 2 where it is in the first and the second label, else 0. Empty where there is no strip.
        """
        nothing = (0, 0, 0, 0), np.zeros((0, 0), dtype=np.uint8)
        if max(first, second) >= len(self._boxes):
            return nothing
        one, other = self._boxes[first], self._boxes[second]
        if one[2] == 0 or other[2] == 0:
            return nothing
        # Where both labels, each grown by the reach, can be.
        rows, columns = (
            slice(max(0, max(one[axis], other[axis]) - reach), min(one[axis + 2], other[axis + 2]) + reach)
            for axis in (0, 1)
        )
        labels = self._labels[rows, columns]
        if labels.size == 0:
            return nothing
        is_first, is_second = ((labels == label).view(np.uint8) for label in (first, second))
        kernel = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
        in_first, in_second = (
            is_first & cv2.dilate(is_second, kernel),
            is_second & cv2.dilate(is_first, kernel),
        )
        strip = np.asarray(in_first | in_second << 1, dtype=np.uint8)
        left, top, width, height = cv2.boundingRect(strip)
        window = rows.start + top, columns.start + left
        return (*window, window[0] + height, window[1] + width), strip[
            top : top + height, left : left + width
        ]
