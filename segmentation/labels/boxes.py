"""Bounding boxes, sizes and inner pixels of the labels of an image."""

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import I32, I64, U16, compiled
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
    _find_boxes(labels, boxes)
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


def label_sizes(labels: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """Count the pixels of each label of an image.

    Parameters
    ----------
    labels : (H, W) int32
        Less than `count`.
    count : int
        Number of labels, with 0.

    Returns
    -------
    (count,) int64
        By label.
    """
    sizes = np.zeros(count, dtype=np.int64)
    _count(labels.reshape(-1), sizes)
    return sizes


@compiled
def _count(labels: I32, sizes: I64) -> None:
    label, begin = np.int32(0), 0
    for n in range(labels.size):
        # Run by run of equal labels.
        if labels[n] != label:
            sizes[label] += n - begin
            label, begin = labels[n], n
    sizes[label] += labels.size - begin


def inner_pixels(labels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Find labelled grid pixels whose eight neighbours have the same label, (h, w) bool."""
    image, around = labels.astype(np.uint16), np.ones((3, 3), dtype=np.uint8)
    return np.asarray((labels > 0) & (cv2.erode(image, around) == cv2.dilate(image, around)))
