"""Lookup tables for labels."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import U16, Bool, compiled


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
    found = np.empty(labels.shape, dtype=np.uint16)
    _look_up(table, read_only(labels), found.reshape(-1))
    return found


def labels_present(labels: NDArray[np.uint16]) -> NDArray[np.intp]:
    """Return the labels that occur in an image, 0 included, (N,) intp in ascending order."""
    present = np.zeros(1 << 16, dtype=np.bool_)
    _mark(read_only(labels), present)
    return np.flatnonzero(present)


def read_only(image: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return an image as a flat read-only array, so that compiled loops see only one type."""
    row = np.ascontiguousarray(image).reshape(-1).view()
    row.flags.writeable = False
    return row


@compiled
def _look_up(table: U16, labels: U16, found: U16) -> None:
    for n in range(labels.size):
        label = labels[n]
        found[n] = table[label] if label < table.size else 0


@compiled
def _mark(labels: U16, present: Bool) -> None:
    before = -1
    for n in range(labels.size):
        label = labels[n]
        if label != before:
            present[label] = True
            before = label
