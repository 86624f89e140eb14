import numpy as np
import pytest

from nurbseg.segmentation.labels.spreading import spread_labels


def in_rounds(labels, wanted, inverse_depth, gap):
    """Labels spread round by round over the whole image, as plainly as can be."""
    labels, height, width = labels.copy(), *labels.shape
    open_places = set(zip(*np.nonzero(wanted), strict=True))
    limit = gap
    while True:
        found = {}
        for r, c in open_places:
            around = [
                (abs(inverse_depth[other] - inverse_depth[r, c]), labels[other])
                for other in ((r, c + 1), (r + 1, c), (r, c - 1), (r - 1, c))
                if 0 <= other[0] < height and 0 <= other[1] < width and labels[other] > 0
            ]
            step, label = min(around, key=lambda pair: pair[0], default=(np.inf, 0))
            if step < limit:
                found[r, c] = label
        if not found and limit == np.inf:
            return labels, open_places
        limit = gap if found else np.inf
        for place, label in found.items():
            labels[place] = label
        open_places -= set(found)


@pytest.mark.parametrize("seed", range(12))
def test_labels_spread_as_in_rounds_over_the_whole_image(seed):
    rng = np.random.default_rng(seed)
    shape = 19, 31
    state = rng.choice(3, size=shape, p=[(0.1, 0.5, 0.05)[seed % 3], 0.1, (0.8, 0.4, 0.85)[seed % 3]])
    labels = np.where(state == 1, rng.integers(1, 5, shape), 0).astype(np.int32)
    inverse_depth = rng.choice(np.linspace(1.0, 1.06, 7), size=shape).astype(np.float32)
    waiting = np.flatnonzero(state == 2)
    spread = labels.copy()
    spread_labels(spread, waiting, inverse_depth, 0.02)
    assert np.array_equal(waiting, np.flatnonzero(state == 2))
    expected, islands = in_rounds(labels, state == 2, inverse_depth, np.float32(0.02))
    rows, columns = np.nonzero(expected > 0)
    for r, c in islands:
        squares = (rows - r) ** 2 + (columns - c) ** 2
        assert spread[r, c] in expected[rows, columns][squares == squares.min()]
        expected[r, c] = spread[r, c]
    assert (spread == expected).all()


def test_without_a_label_nothing_spreads():
    labels = np.zeros((5, 6), np.int32)
    spread_labels(labels, np.arange(30), np.ones((5, 6), np.float32), 0.02)
    assert not labels.any()
