from collections import deque

import numpy as np
import pytest

from nurbseg.segmentation.labels.regions import (
    connected_components,
    large_components,
    pixel_adjacency,
)


def flooded(labels, inverse_depth, gap):
    """Components by a flood from every place, as plainly as can be."""
    height, width = labels.shape
    pieces = np.zeros(labels.shape, dtype=int)
    count = 0
    for start in zip(*np.nonzero(labels), strict=True):
        if pieces[start]:
            continue
        count += 1
        pieces[start] = count
        queue = deque([start])
        while queue:
            r, c = queue.popleft()
            for other in ((r + 1, c), (r - 1, c), (r, c + 1), (r, c - 1)):
                if (
                    0 <= other[0] < height
                    and 0 <= other[1] < width
                    and not pieces[other]
                    and labels[other] == labels[r, c]
                    and abs(inverse_depth[other] - inverse_depth[r, c]) < gap
                ):
                    pieces[other] = count
                    queue.append(other)
    return count, pieces


@pytest.mark.parametrize("seed", range(8))
def test_pieces_are_those_of_a_flood(seed):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, (17, 23)).astype(np.int32)
    inverse_depth = np.cumsum(rng.normal(0, 0.02, (17, 23)), axis=1).astype(np.float32)
    found = connected_components(labels, pixel_adjacency(inverse_depth, np.ones((17, 23), bool), 0.02))
    count, expected = flooded(labels, inverse_depth, np.float32(0.02))
    assert (found.numbers == expected).all()
    assert all((labels[expected == n] == found.labels_of[n]).all() for n in range(count + 1))
    assert found.small.size == 0
    large = connected_components(labels, pixel_adjacency(inverse_depth, np.ones((17, 23), bool), 0.02), 3.0)
    is_large = np.bincount(expected.ravel()) >= 3
    is_large[0] = False
    assert (large.numbers == np.where(is_large, np.cumsum(is_large), 0)[expected]).all()
    assert (large.labels_of[1:] == found.labels_of[is_large]).all()
    assert (large.small == np.flatnonzero((labels > 0) & ~is_large[expected])).all()


def test_the_largest_piece_of_a_label_is_kept_however_small():
    labels = np.array([[1, 1, 0, 1, 0, 2, 0, 3, 3, 3, 3, 0, 1, 1]], np.int32)
    adjacency = pixel_adjacency(np.ones(labels.shape, np.float32), labels > 0, 0.02)
    # Of equally large ones, the last.
    for least, numbers in (
        (4.0, [[0, 0, 0, 0, 0, 1, 0, 2, 2, 2, 2, 0, 3, 3]]),
        (5.0, [[0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 2, 2]]),
    ):
        found = connected_components(labels, adjacency, least, keep=2)
        assert found.numbers.tolist() == numbers
        assert found.small.tolist() == np.flatnonzero((labels > 0) & (found.numbers == 0)).tolist()


def test_small_pieces_go_to_the_neighbour_nearest_in_depth():
    inverse_depth = np.ones((12, 20), np.float32)
    inverse_depth[:, 10:] = 1.5
    labels = np.where(np.arange(20) < 10, 1, 2)[np.newaxis].repeat(12, axis=0).astype(np.int32)
    labels[4:6, 10:12] = 1  # a speck of label 1 on the other side of the gap
    # The first row and the last column are not looked at.
    places = np.arange(12 * 20).reshape(12, 20)[1:, :-1].ravel()
    pieces, label_of = large_components(
        places,
        labels.ravel()[places],
        pixel_adjacency(inverse_depth, np.ones((12, 20), bool), 0.02),
        inverse_depth,
        gap_per_m=0.02,
        grid_pixels_min=10,
    )
    assert label_of == [1, 2]
    assert (pieces[0] == places[places % 20 < 10]).all()
    assert (pieces[1] == places[places % 20 >= 10]).all()


def test_nothing_is_found_where_no_piece_is_large_enough():
    inverse_depth = np.ones((4, 4), np.float32)
    adjacency = pixel_adjacency(inverse_depth, np.ones((4, 4), bool), 0.02)
    places = np.arange(16)
    labels = np.ones(16, np.int32)
    assert large_components(
        places, labels, adjacency, inverse_depth, gap_per_m=0.02, grid_pixels_min=100
    ) == (
        [],
        [],
    )
