"""Tables applied to label images."""

import numpy as np

from nurbseg.segmentation.labels.lookup import apply_lookup_table, labels_present


def test_every_label_is_looked_up_and_those_beyond_the_table_are_none() -> None:
    labels = np.random.default_rng(0).integers(0, 7, (20, 30)).astype(np.uint16)
    table = np.array([0, 9, 8, 7, 65535], np.uint16)
    found = apply_lookup_table(table, labels)
    assert np.array_equal(found, np.append(table, [0, 0])[labels])
    # Part of an image will do, and one that may not be written to.
    part = labels[::2, ::3]
    part.flags.writeable = False
    assert np.array_equal(apply_lookup_table(table, part), found[::2, ::3])


def test_labels_present_returns_the_labels_that_occur() -> None:
    labels = np.array([[5, 5, 0], [65535, 5, 1]], np.uint16)
    assert labels_present(labels).tolist() == [0, 1, 5, 65535]
    for label in (0, 1, 3):
        assert labels_present(np.full((2, 2), label, np.uint16)).tolist() == [label]
