import numpy as np

from nurbseg.segmentation.labels.images import (
    apply_lookup_table,
    bounding_boxes,
    by_label,
    label_sizes,
)


def test_boxes_are_the_extremes_of_each_labels_rows_and_columns():
    labels = np.random.default_rng(0).choice(9, (12, 15), p=[0.9, *[0.0125] * 8]).astype(np.uint16)
    labels[labels == 4] = 0
    labels[7, 3:9] = 5
    boxes = bounding_boxes(labels, 10)
    for label in range(10):
        rows, columns = np.nonzero(labels == label)
        extremes = (
            (rows.min(), columns.min(), rows.max() + 1, columns.max() + 1) if rows.size else (12, 15, 0, 0)
        )
        assert boxes[label] == extremes
    assert boxes[4] == boxes[9] == (12, 15, 0, 0)


def test_sizes_are_the_pixels_of_each_label():
    labels = np.random.default_rng(1).choice(7, (12, 15), p=[0.4, 0.3, 0.3, 0, 0, 0, 0]).astype(np.int32)
    labels[0, 0], labels[-1, -3:] = 5, 4
    for image in (labels, labels[::2, ::3], np.zeros((4, 0), dtype=np.int32)):
        assert label_sizes(image, 9).tolist() == [np.count_nonzero(image == label) for label in range(9)]


def test_places_are_sorted_by_label_and_keep_their_order_within_each() -> None:
    labels = np.random.default_rng(1).integers(0, 9, 500)
    labels[labels == 4] = 5
    for dtype in (np.uint16, np.int32):
        order, bounds = by_label(labels.astype(dtype), 10)
        assert np.array_equal(order, np.argsort(labels, kind="stable"))
        assert np.array_equal(np.diff(bounds), np.bincount(labels, minlength=10))


def test_every_label_is_looked_up_and_those_beyond_the_table_are_none() -> None:
    labels = np.random.default_rng(0).integers(0, 7, (20, 30)).astype(np.uint16)
    # What lies behind the table in memory is no label.
    table = np.array([0, 9, 8, 7, 65535, 6, 6], np.uint16)[:5]
    found = apply_lookup_table(table, labels)
    assert np.array_equal(found, np.append(table, [0, 0])[labels])
    # Part of an image will do, and one that may not be written to.
    part = labels[::2, ::3]
    part.flags.writeable = False
    assert np.array_equal(apply_lookup_table(table, part), found[::2, ::3])
