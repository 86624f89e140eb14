"""Label images: boxes, sizes, pixels by label, and lookup tables."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import I32, I64, U16, Intp, compiled
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
    return [(top, left, bottom, right) for top, left, bottom, right in _boxes(labels, count).tolist()]


@compiled
def _boxes(labels: U16, count: int) -> I64:
    height, width = labels.shape
    boxes = np.zeros((count, 4), dtype=np.int64)
    boxes[:, 0], boxes[:, 1] = height, width
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
    return boxes


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
    return _sizes(labels.reshape(-1), count)


@compiled
def _sizes(labels: I32, count: int) -> I64:
    sizes = np.zeros(count, dtype=np.int64)
    label, begin = np.int32(0), 0
    for n in range(labels.size):
        # Run by run of equal labels.
        if labels[n] != label:
            sizes[label] += n - begin
            label, begin = labels[n], n
    sizes[label] += labels.size - begin
    return sizes


def by_label(labels: NDArray[np.integer], count: int) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Sort the pixels of an image by label.

    Parameters
    ----------
    labels : (N,) uint16 or int32
        0 to ``count - 1``.
    count : int
        Number of labels.

    Returns
    -------
    order : (N,) intp
        The pixels of label 0, of label 1, and so on, ascending within each.
    bounds : (count + 1,) int64
        Where those of each label begin in `order`, and its length.
    """
    return _sort_by_label(labels.astype(np.uint16, copy=False), count)


@compiled
def _sort_by_label(labels: U16, count: int) -> tuple[Intp, I64]:
    """Sort by counting, run by run of equal labels."""
    order, bounds = np.empty(labels.size, dtype=np.intp), np.zeros(count + 1, dtype=np.int64)
    starts, runs = np.empty(labels.size + 1, dtype=np.int64), 0
    for pixel in range(labels.size):
        if pixel == 0 or labels[pixel] != labels[pixel - 1]:
            starts[runs] = pixel
            runs += 1
    starts[runs] = labels.size
    for run in range(runs):
        bounds[labels[starts[run]] + 1] += starts[run + 1] - starts[run]
    for label in range(1, bounds.size):
        bounds[label] += bounds[label - 1]
    following = bounds.copy()
    for run in range(runs):
        pixel, size = starts[run], starts[run + 1] - starts[run]
        at = np.uint32(following[labels[pixel]])
        for n in range(size):
            order[at + n] = pixel + n
        following[labels[pixel]] += size
    return order, bounds


def apply_lookup_table(table: NDArray[np.uint16], labels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Look up each label of an image.

    Parameters
    ----------
    table : (N,) uint16
        New labels for 0, 1, ...
    labels : (H, W) uint16
        The image.

    Returns
    -------
    (H, W) uint16
        0 for labels beyond the table.
    """
    return _look_up(table, read_only(labels)).reshape(labels.shape)


def read_only(image: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return an image as a flat read-only array, so that compiled loops see only one type."""
    row = np.ascontiguousarray(image).reshape(-1).view()
    row.flags.writeable = False
    return row


@compiled
def _look_up(table: U16, labels: U16) -> U16:
    found = np.empty(labels.size, dtype=np.uint16)
    for n in range(labels.size):
        label = labels[n]
        found[n] = table[label] if label < table.size else 0
    return found
