"""Bounding boxes of the labels of an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import I64, U16, compiled
from nurbseg.segmentation.points.grid import Window


def bounding_boxes(labels: NDArray[np.uint16], count: int) -> list[Window]:
    """Find the first row and column of each label, and one past the last of each.

    Parameters
    ----------
    labels : (H, W) uint16
        Less than `count`.
    count : int
        Number of labels, with 0.

    Returns
    -------
    list of (int, int, int, int)
        By label; (H, W, 0, 0) for one without pixels.
    """
    boxes = np.empty((count, 4), dtype=np.int64)
    _find_boxes(np.ascontiguousarray(labels), boxes)
    return [(top, left, bottom, right) for top, left, bottom, right in boxes.tolist()]


@compiled
def _find_boxes(labels: U16, boxes: I64) -> None:
    height, width = labels.shape
    boxes[:, 0], boxes[:, 1], boxes[:, 2:] = height, width, 0
    for row in range(height):
        line, column = labels[row], 0
        while column < width:
            label, begin = line[column], column
            while column < width and line[column] == label:
                column += 1
            box = boxes[label]
            box[0] = min(box[0], row)
            box[1] = min(box[1], begin)
            box[2] = row + 1
            box[3] = max(box[3], column)
