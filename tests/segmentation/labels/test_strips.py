import numpy as np
import pytest

from nurbseg.segmentation.labels.strips import BorderStrips


@pytest.mark.parametrize("seed", range(10))
def test_strips_are_those_of_a_search_around_every_place(seed):
    rng = np.random.default_rng(seed)
    shape, reach = (23, 31), 1 + seed % 4
    # Blobs of three labels, apart and together.
    labels = np.zeros(shape, np.int32)
    for label in rng.integers(1, 4, 9):
        top, left = rng.integers(0, 20), rng.integers(0, 28)
        labels[top : top + rng.integers(1, 9), left : left + rng.integers(1, 9)] = label
    strips = BorderStrips(labels)
    for first, second in ((1, 2), (1, 3), (2, 3)):
        expected = np.zeros(shape, np.uint8)
        for r, c in zip(*np.nonzero((labels == first) | (labels == second)), strict=True):
            around = labels[max(0, r - reach) : r + reach + 1, max(0, c - reach) : c + reach + 1]
            if labels[r, c] == first and (around == second).any():
                expected[r, c] = 1
            if labels[r, c] == second and (around == first).any():
                expected[r, c] = 2
        (top, left, bottom, right), found = strips.strip(first, second, reach)
        assert found.shape == (bottom - top, right - left)
        assert np.count_nonzero(found) == np.count_nonzero(expected)
        assert (found == expected[top:bottom, left:right]).all()
        if found.size:
            assert found.any(axis=0)[[0, -1]].all()
            assert found.any(axis=1)[[0, -1]].all()


def test_a_label_that_is_nowhere_has_no_strip():
    strips = BorderStrips(np.array([[1, 1, 3]], np.int32))
    for pair in ((1, 2), (1, 4), (2, 3)):
        assert strips.strip(*pair, 5)[1].size == 0
