import numpy as np
import pytest

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.ncut import normalized_cut
from nurbseg.segmentation.points.grid import decimated_grid
from nurbseg.segmentation.segments import Node
from nurbseg.segmentation.upsample import CarriedLabels, upsample_by_depth, upsample_labels


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
    return cloud, vectors, grid, tree(cut, places[~cut.side], places[cut.side])


def tree(cut, *parts):
    """Two leaves, parts of a cut."""
    return Node("", None, None, tuple(Node(f"{n}", part, None) for n, part in enumerate(parts)), cut=cut)


def test_pixels_near_a_border_go_where_the_cut_puts_them(cloud_of):
    for step in (1, 2, 3, 4, 7):
        cloud, vectors, grid, root = scene(cloud_of, step)
        labels = upsample_labels(cloud, grid, root, vectors.__getitem__)
        expected = np.where(cloud.valid.ravel(), 1 + root.cut.classify(vectors), 0)
        assert (labels.ravel() == expected).all(), step


def test_pixels_away_from_the_border_are_not_evaluated(cloud_of):
    cloud, vectors, grid, root = scene(cloud_of, 4)
    asked = []

    def vectors_of(pixels):
        asked.append(pixels)
        return vectors[pixels]

    upsample_labels(cloud, grid, root, vectors_of)
    columns = np.concatenate(asked) % 61
    assert (np.abs(columns - 30) <= 4).all()


def test_the_clean_up_of_the_grid_is_kept(cloud_of):
    cloud, vectors, grid, root = scene(cloud_of, 2)
    everything = np.flatnonzero(grid.valid)
    leaves = Node("00", everything[:155], None), Node("01", everything[155:310], None)
    first = Node("0", None, None, leaves, cut=root.cut)
    other = Node("", None, None, (first, Node("1", everything[310:], None)), cut=root.cut)
    labels = upsample_labels(cloud, grid, other, vectors.__getitem__)
    # Rows between those of one leaf belong to it, whatever the cuts say about their vectors.
    for label, rows in ((1, slice(8)), (2, slice(10, 18)), (3, slice(20, None))):
        assert (labels[rows][cloud.valid[rows]] == label).all()
    # Between two leaves the cut of these two decides.
    side = root.cut.classify(vectors[:61])
    assert (labels[9] == 1 + side).all()
    assert (labels[19] == 2 + side).all()


@pytest.mark.parametrize("column", [9, 51])
def test_a_pixel_with_nothing_around_it_walks_down_the_tree(cloud_of, column):
    _, vectors, grid, root = scene(cloud_of, 2)
    valid = np.zeros((40, 61))
    valid[:] = np.nan
    valid[11, column] = 1.0
    lonely = cloud_of(valid)
    labels = upsample_labels(lonely, grid, root, vectors.__getitem__)
    none = tree(root.cut, *(part.grid_pixels[:0] for part in root.children))
    alone = upsample_labels(lonely, decimated_grid(lonely, 2), none, vectors.__getitem__)
    side = root.cut.classify(vectors[[11 * 61 + column]])[0]
    assert labels[11, column] == alone[11, column] == 1 + int(side)


def test_one_leaf_takes_every_pixel(cloud_of):
    cloud, vectors, grid, _ = scene(cloud_of, 3)
    whole = Node("", np.flatnonzero(grid.valid), None)
    assert (upsample_labels(cloud, grid, whole, vectors.__getitem__) == cloud.valid).all()


def test_pixels_keep_the_label_of_the_frame_before_where_that_of_their_grid_pixel_is_the_same():
    before = np.array([[1, 1, 2, 2, 2], [1, 2, 2, 2, 4], [1, 1, 1, 1, 2]], dtype=np.uint16)
    # Labels have other numbers now, and 4 is gone.
    carried = CarriedLabels(before, np.array([0, 5, 6, 7, 0], dtype=np.uint16))
    on_grid = np.array([[5, 7, 6], [5, 5, 6]], dtype=np.int32)
    valid = np.ones(before.shape, dtype=bool)
    valid[1, 3] = False
    config = SegmentationConfig(decimation=2)
    inverse_depth = valid.astype(np.float32)
    found = upsample_by_depth(on_grid, inverse_depth, valid, config, carried)
    # That of the middle one has changed; the last of the second row has none to keep.
    assert found.tolist() == [[5, 5, 7, 7, 6], [5, 6, 7, 0, 6], [5, 5, 5, 5, 6]]
