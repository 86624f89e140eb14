"""Labels of all pixels from those on the grid: by the cuts of a tree, or as in the frame before."""

import numpy as np
import pytest

from nurbseg.segmentation.config import SegmentationConfig, Stag15Config
from nurbseg.segmentation.cut.features import normalization, normalized, raw_vectors
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.grid import decimated_grid
from nurbseg.segmentation.upsample import CarriedLabels, upsample_by_depth


@pytest.mark.parametrize("step", [2, 3, 4, 7])
def test_pixels_near_a_border_go_where_the_cut_puts_them_and_others_with_their_grid_pixel(cloud_of, step):
    depth = np.where(np.mgrid[:85, :127][1] > 61, 1.5, 1.0)
    # At last two that are near nothing of the grid.
    depth[5, 7:12], depth[60:] = np.nan, np.nan
    depth[71, [9, 113]] = 1.0, 1.5
    cloud = cloud_of(depth, np.where(depth[..., np.newaxis] > 1.2, (200, 180, 60), (40, 90, 160)))
    config = SegmentationConfig(
        method="stag15", decimation=step, splits_max=1, stag15=Stag15Config(segment_pixels_min=20_000)
    )
    tree = segment(cloud, config)
    grid = decimated_grid(cloud, step)
    places = np.flatnonzero(grid.valid)
    scale = normalization(raw_vectors(cloud, grid.pixels(places)), config.geometry_weight)
    every = np.flatnonzero(cloud.valid)
    side = tree.root.cut.classify(normalized(raw_vectors(cloud, every), scale))
    assert 0.2 < side.mean() < 0.8
    assert np.array_equal(tree.labels("surfaces")[cloud.valid], 1 + side)


def test_pixels_go_to_one_of_the_leaves_around_them_whatever_the_cuts_above_say(cloud_of):
    # Two red parts and a blue one; between the red ones, and between pixels of the grid, some are blue.
    part = np.mgrid[:80, :120][1] // 40
    color = np.array([(120, 0, 0), (250, 60, 60), (0, 0, 250)])[part]
    color[1::2, 39] = 0, 0, 250
    config = SegmentationConfig(method="stag15", decimation=2, splits_max=2, geometry_weight=0.0)
    tree = segment(cloud_of(np.array([1.0, 1.5, 2.2])[part], color), config)
    labels = tree.labels("surfaces")
    assert [leaf.pixels.size for leaf in tree.leaves()] == [3200] * 3
    assert {*labels[:, :80].flat} == {labels[5, 5], labels[5, 60]}


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
