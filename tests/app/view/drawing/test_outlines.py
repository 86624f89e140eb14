"""Outlines of labels as the viewer shows them over the photo."""

from __future__ import annotations

import cv2
import numpy as np

from nurbseg.app.view.drawing.outlines import outlines


def lines(labels: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Label and outline of each region."""
    found = outlines(labels)
    assert found.strips is not None and found.class_ids is not None
    return list(
        zip(
            found.class_ids.as_arrow_array().to_pylist(),
            [np.array(each) for each in found.strips.as_arrow_array().to_pylist()],
            strict=True,
        )
    )


def test_regions_have_closed_outlines_in_their_labels_but_for_the_largest() -> None:
    labels = np.full((480, 640), 7, np.uint16)
    labels[:50] = 0
    labels[100:200, 300:340] = 40_000
    labels[300:400, 100:150] = 3
    # A ring, and what is in it; and two regions of one label, one of them tiny.
    cv2.circle(labels, (500, 300), 60, 9, -1)
    cv2.circle(labels, (500, 300), 30, 3, -1)
    labels[460:463, 10:14] = 3
    found = lines(labels)
    assert sorted(label for label, _ in found) == [3, 3, 9, 40_000]
    for label, line in found:
        assert np.array_equal(line[0], line[-1])
        inside = np.zeros(labels.shape, np.uint8)
        cv2.fillPoly(inside, [np.rint(line - 0.5).astype(np.int32)], 1)
        labeled = (labels == label) | ((labels == 3) & (label == 9))
        # Within a pixel of the region, of which the label may have others.
        assert (inside <= cv2.dilate(labeled.astype(np.uint8), np.ones((3, 3)))).all()
        assert (inside >= cv2.erode((inside & labeled).astype(np.uint8), np.ones((3, 3)))).all()
        assert inside.sum() > 0.97 * (labeled & (inside > 0)).sum() > 1000
    square = next(line for label, line in found if label == 40_000)
    assert {tuple(corner) for corner in square.tolist()} == {
        (x, y) for x in (300.5, 339.5) for y in (100.5, 199.5)
    }


def test_steps_of_a_border_are_smooth() -> None:
    labels = np.full((480, 640), 2, np.uint16)
    for row in range(480):
        labels[row, : 100 + row // 3] = 1
    ((label, line),) = lines(labels)
    assert (label, len(line)) == (1, 5)


def test_no_label_has_no_outline() -> None:
    assert lines(np.zeros((48, 64), np.uint16)) == []
    assert lines(np.full((48, 64), 2, np.uint16)) == []
