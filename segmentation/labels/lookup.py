"""Labels in place of labels: tables applied to images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import U16, Bool, compiled


def apply_lookup_table(table: NDArray[np.uint16], labels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Look up each label of an image.

    Parameters
    ----------
    table : (N,) uint16
        What to put in place of the labels 0, 1, ...
    labels : (H, W) uint16
        The image.

    Returns
    -------
    (H, W) uint16
        0 for labels that the table does not hold.
    """
    found = np.empty(labels.shape, dtype=np.uint16)
    _look_up(table, read_only(labels), found.reshape(-1))
    return found


def labels_present(labels: NDArray[np.uint16]) -> NDArray[np.intp]:
    """Return the labels that an image holds, (N,) intp in ascending order, 0 among them if it is there."""
    is_there = np.zeros(1 << 16, dtype=np.bool_)
    _mark(read_only(labels), is_there)
    return np.flatnonzero(is_there)


def read_only(image: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return an image as one read-only row, which compiled loops take for one type whoever calls them."""
    row = np.ascontiguousarray(image).reshape(-1).view()
    row.flags.writeable = False
    return row


@compiled
def _look_up(table: U16, labels: U16, found: U16) -> None:
    """Take the table's entry of each label."""
    for n in range(labels.size):
        label = labels[n]
        found[n] = table[label] if label < table.size else 0


@compiled
def _mark(labels: U16, is_there: Bool) -> None:
    """Mark the labels that are there, each run of equal ones at its first."""
    before = -1
    for n in range(labels.size):
        label = labels[n]
        if label != before:
            is_there[label] = True
            before = label
