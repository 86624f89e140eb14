from collections import deque

import numpy as np
import pytest

from nurbseg.segmentation.pieces import connected_pieces, joints, large_pieces, spread_labels


def flooded(labels, per_m, gap):
    """Pieces by a flood from every place, as plainly as can be."""
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
                    and abs(per_m[other] - per_m[r, c]) < gap
                ):
                    pieces[other] = count
                    queue.append(other)
    return count, pieces


@pytest.mark.parametrize("seed", range(8))
def test_pieces_are_those_of_a_flood(seed):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, (17, 23)).astype(np.int32)
    per_m = np.cumsum(rng.normal(0, 0.02, (17, 23)), axis=1).astype(np.float32)
    count, pieces = connected_pieces(labels, joints(per_m, np.ones((17, 23), bool), 0.02))
    expected_count, expected = flooded(labels, per_m, np.float32(0.02))
    assert count == expected_count
    # The same partition: numbers correspond one to one.
    assert len(np.unique(np.stack([pieces, expected], axis=-1).reshape(-1, 2), axis=0)) == (
        count + (labels == 0).any()
    )


def test_a_gap_in_depth_parts_what_touches_in_the_image():
    per_m = np.ones((10, 12), np.float32)
    per_m[:, 6:] = 1.1
    labels = np.ones((10, 12), np.int32)
    valid = np.ones((10, 12), bool)
    assert connected_pieces(labels, joints(per_m, valid, 0.02))[0] == 2
    assert connected_pieces(labels, joints(per_m, valid, 0.2))[0] == 1


def test_a_slope_is_no_gap():
    per_m = np.broadcast_to(0.015 * np.arange(40, dtype=np.float32), (10, 40))
    assert connected_pieces(np.ones((10, 40), np.int32), joints(per_m, np.ones((10, 40), bool), 0.02))[0] == 1


def test_small_pieces_go_to_the_neighbour_nearest_in_depth():
    per_m = np.ones((12, 20), np.float32)
    per_m[:, 10:] = 1.5
    labels = np.where(np.arange(20) < 10, 1, 2)[np.newaxis].repeat(12, axis=0).astype(np.int32)
    labels[4:6, 10:12] = 1  # a speck of label 1 on the other side of the gap
    pieces, label_of = large_pieces(
        labels, joints(per_m, np.ones((12, 20), bool), 0.02), per_m, gap_per_m=0.02, places_min=10
    )
    assert label_of.tolist() == [1, 2]
    assert (pieces == np.where(np.arange(20) < 10, 1, 2)).all()


def test_nothing_is_found_where_no_piece_is_large_enough():
    per_m = np.ones((4, 4), np.float32)
    pieces, label_of = large_pieces(
        np.ones((4, 4), np.int32),
        joints(per_m, np.ones((4, 4), bool), 0.02),
        per_m,
        gap_per_m=0.02,
        places_min=100,
    )
    assert label_of.size == 0
    assert not pieces.any()


def test_islands_take_the_label_of_the_nearest_place():
    labels = np.zeros((9, 30), np.int32)
    labels[:, :5], labels[:, 25:] = 1, 2
    wanted = np.zeros((9, 30), bool)
    wanted[4, 8], wanted[4, 22] = True, True
    spread = spread_labels(labels, wanted, np.ones((9, 30), np.float32), 0.02)
    assert spread[4, 8] == 1
    assert spread[4, 22] == 2
    assert np.count_nonzero(spread) == np.count_nonzero(labels) + 2
