"""The lens model, compared with OpenCV's projection."""

import cv2
import numpy as np
import pytest

from nurbseg.common.lens import lens_terms


@pytest.mark.parametrize(
    ("distortion", "folds"),
    [
        ([], False),
        ([0.1, 0.02, 0.0, 0.0], False),
        ([-0.3, 0.05, 0.0, 0.0, 0.01], False),
        ([-0.3, 0.05, 0.0, 0.0, -0.01], True),
        ([0.2, -0.4, 0.0, 0.0, 0.0, 0.6, -0.1, 0.02], True),
        ([5.0, 3.0, 0.0, 0.0, 0.1, 5.2, 4.0, 0.6], False),
        ([0.4, 0.1, 0.0, 0.0, 0.0, 0.1, 0.05, 0.0], False),
    ],
)
def test_it_folds_where_points_come_back_into_the_image(distortion: list[float], folds: bool) -> None:
    r = np.linspace(0.0, 10.0, 10_001)
    rays, none = np.column_stack([r, np.zeros(r.size), np.ones(r.size)]), np.zeros(3)
    given = np.array(distortion)
    image = cv2.projectPoints(rays, none, none, np.eye(3), given if given.size else None)[0]
    back = np.flatnonzero(np.diff(image[:, 0, 0]) <= 0)
    assert bool(back.size) == folds
    assert lens_terms(given)[1] == pytest.approx(r[back[0]] if folds else np.inf)
