"""The faces of ten real frames, which surfaces are judged by."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage

FACES = Path(__file__).parents[2] / "faces"
NAMES = sorted(path.stem for path in FACES.glob("*.png"))


def test_ten_frames_have_faces():
    assert len(NAMES) == 10


@pytest.mark.parametrize("name", NAMES)
def test_a_face_is_one_part_of_one_object(real_data, name):
    folder = real_data("mosd_learn" if name.startswith("learn") else "mosd_clutter")
    objects, depth = (
        cv2.imread(str(folder / f"{name}_{kind}.png"), cv2.IMREAD_UNCHANGED) for kind in ("label", "depth")
    )
    faces = cv2.imread(str(FACES / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    known = (objects > 0) & (depth > 0)
    assert not faces[~known].any()
    assert (faces[known] > 0).mean() > 0.99
    assert sorted(np.unique(faces[faces > 0])) == list(range(1, faces.max() + 1))
    divided = 0
    for face in range(1, faces.max() + 1):
        of = np.unique(objects[faces == face])
        assert of.size == 1
        # The data set's own regions are taken as they are, in several parts or not.
        divided += (faces[objects == of[0]] != face).any()
        pieces = ndimage.label(faces == face, np.ones((3, 3)))[1]
        assert pieces == 1 or not (faces[(objects == of[0]) & (faces > 0)] != face).any()
    assert divided >= 4
