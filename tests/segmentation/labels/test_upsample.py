import numpy as np
import pytest

from nurbseg.segmentation.cut.ncut import normalized_cut
from nurbseg.segmentation.labels.upsample import Split, upsample_labels
from nurbseg.segmentation.points.grid import decimated_grid


def scene(cloud_of, step: int):
    """Left and right half, told apart by one number per pixel; the border is at column 30.5."""
    depth = np.ones((40, 61))
    depth[5, 7:12] = np.nan
    cloud = cloud_of(depth)
    vectors = np.zeros((40 * 61, 6), dtype=np.float32)
    vectors[:, 0] = np.where(np.arange(40 * 61) % 61 > 30, 2.0, -2.0)
    grid = decimated_grid(cloud, step)
    places = np.flatnonzero(grid.valid)
    cut = normalized_cut(vectors[grid.pixels(places)], samples=30, rng=np.random.default_rng(0))
    leaves = [places[~cut.side], places[cut.side]]
    return cloud, vectors, grid, cut, leaves


def test_pixels_near_a_border_go_where_the_cut_puts_them(cloud_of):
    for step in (1, 2, 3, 4, 7):
        cloud, vectors, grid, cut, leaves = scene(cloud_of, step)
        labels = upsample_labels(cloud, grid, leaves, [Split(0, 1, 2, cut)], vectors.__getitem__)
        expected = np.where(cloud.valid.ravel(), cut.classify(vectors), 2)
        assert (labels == expected).all(), step


def test_pixels_away_from_the_border_are_not_evaluated(cloud_of):
    cloud, vectors, grid, cut, leaves = scene(cloud_of, 4)
    asked = []

    def vectors_of(pixels):
        asked.append(pixels)
        return vectors[pixels]

    upsample_labels(cloud, grid, leaves, [Split(0, 1, 2, cut)], vectors_of)
    columns = np.concatenate(asked) % 61
    assert (np.abs(columns - 30) <= 4).all()


def test_the_clean_up_of_the_grid_is_kept(cloud_of):
    cloud, vectors, grid, cut, _ = scene(cloud_of, 2)
    everything = np.flatnonzero(grid.valid)
    labels = upsample_labels(
        cloud, grid, [everything[:100], everything[100:]], [Split(0, 1, 2, cut)], vectors.__getitem__
    )
    # Rows from 20 on belong to the second leaf, whatever the cut says about their vectors.
    image = labels.reshape(40, 61)
    assert (image[20:][cloud.valid[20:]] == 1).all()


@pytest.mark.parametrize("column", [9, 51])
def test_a_pixel_with_nothing_around_it_walks_down_the_tree(cloud_of, column):
    _, vectors, grid, cut, leaves = scene(cloud_of, 2)
    valid = np.zeros((40, 61))
    valid[:] = np.nan
    valid[11, column] = 1.0
    lonely = cloud_of(valid)
    labels = upsample_labels(lonely, grid, leaves, [Split(0, 1, 2, cut)], vectors.__getitem__)
    none = [places[:0] for places in leaves]
    alone = upsample_labels(
        lonely, decimated_grid(lonely, 2), none, [Split(0, 1, 2, cut)], vectors.__getitem__
    )
    pixel = 11 * 61 + column
    assert labels[pixel] == alone[pixel] == int(cut.classify(vectors[[pixel]])[0])


def test_one_leaf_takes_every_pixel(cloud_of):
    cloud, vectors, grid, _, _ = scene(cloud_of, 3)
    labels = upsample_labels(cloud, grid, [np.flatnonzero(grid.valid)], [], vectors.__getitem__)
    assert (labels == np.where(cloud.valid.ravel(), 0, 1)).all()


def test_there_are_as_many_leaves_as_labels_of_16_bits_at_most(cloud_of):
    cloud = cloud_of(np.ones((256, 256)))
    leaves = list(np.arange(2**16 - 1)[:, np.newaxis])
    labels = upsample_labels(cloud, decimated_grid(cloud, 1), leaves[:-1], [], np.ones)
    assert (labels == np.minimum(np.arange(2**16), 2**16 - 2)).all()
    with pytest.raises(ValueError, match="at most 65534, got 65535"):
        upsample_labels(cloud, decimated_grid(cloud, 1), leaves, [], np.ones)
