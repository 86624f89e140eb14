"""Which share of an object's border is hidden, against sets of pixels."""

import numpy as np
import pytest
from scipy.ndimage import binary_fill_holes

from nurbseg.library.boxes.borders import hidden_shares
from nurbseg.segmentation.points.registration import PointMap

NOISE = 2e-3
SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))


def shares(labels, inverse_depth):
    """Every third pixel of an image three times as large is one of these."""
    image = np.kron(labels, np.ones((3, 3))).astype(np.uint16)
    points_m = np.full((*image.shape, 3), np.nan, dtype=np.float32)
    points_m[image > 0] = [0.0, 0.0, 1.0]
    points_m /= np.kron(np.maximum(inverse_depth, 1e-6), np.ones((3, 3)))[..., np.newaxis]
    cloud = PointMap(points_m, np.zeros((*image.shape, 3), np.uint8), image > 0)
    count = int(labels.max()) + 1
    return hidden_shares(image, np.arange(count, dtype=np.uint16), cloud, NOISE)


def expected_share(labels, inverse_depth, own):
    ends = hidden = 0
    enclosed = binary_fill_holes(labels == own) & (labels != own)
    for row, column in np.argwhere(labels == own):
        for down, across in SIDES:
            r, c = row + down, column + across
            if not (0 <= r < labels.shape[0] and 0 <= c < labels.shape[1]):
                ends, hidden = ends + 1, hidden + 1
            elif labels[r, c] != own:
                in_front = labels[r, c] > 0 and inverse_depth[r, c] - inverse_depth[row, column] > 4 * NOISE
                if not (enclosed[r, c] and (in_front or labels[r, c] == 0)):
                    ends, hidden = ends + 1, hidden + in_front
    return hidden / max(ends, 1)


@pytest.mark.parametrize("seed", range(20))
def test_border_is_hidden_at_the_images_edge_and_behind_what_is_not_enclosed(seed):
    rng = np.random.default_rng(seed)
    labels = np.zeros((24, 32), dtype=np.int64)
    inverse_depth = np.zeros(labels.shape)
    for own in range(1, 9):
        top, left = rng.integers(0, 20), rng.integers(0, 28)
        part = np.s_[top : top + rng.integers(3, 14), left : left + rng.integers(3, 16)]
        labels[part], inverse_depth[part] = own, rng.uniform(0.5, 1.5)
    for _ in range(6):
        top, left = rng.integers(0, 22), rng.integers(0, 30)
        labels[top : top + 2, left : left + 3] = 0
    inverse_depth[labels == 0] = 0.0
    found = shares(labels, inverse_depth)
    mirrored = shares(labels[::-1, ::-1], inverse_depth[::-1, ::-1])
    assert found[0] == 0
    for own in range(1, labels.max() + 1):
        if (labels == own).any():
            wanted = expected_share(labels, inverse_depth, own)
            assert found[own] == mirrored[own] == pytest.approx(wanted)
