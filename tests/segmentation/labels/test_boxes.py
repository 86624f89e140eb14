import numpy as np

from nurbseg.segmentation.labels.boxes import bounding_boxes, label_sizes


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
