from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.features import lab
from nurbseg.segmentation.extended.grid_features import grid_features

CONFIG = SegmentationConfig(method="nurbseg")


@pytest.fixture
def cloud(box_on_table, cloud_of):
    depth, _ = box_on_table((61, 83), noise_per_m=1e-3)
    depth[10:20, 30:50] = np.nan
    color = np.random.default_rng(0).integers(0, 255, (61, 83, 3))
    return cloud_of(depth, color)


@pytest.mark.parametrize("step", [1, 2, 3, 4])
def test_vectors_hold_color_position_and_normal_of_each_place(cloud, step):
    features = grid_features(cloud, replace(CONFIG, decimation=step))
    valid = cloud.valid[::step, ::step]
    assert_array_equal(features.grid.valid, valid)
    raw = features.raw_vectors(np.flatnonzero(valid))
    assert_array_equal(raw[:, :3], lab(cloud.color[::step, ::step][valid]))
    assert_array_equal(raw[:, 3:6], cloud.points_m[::step, ::step][valid])
    assert_allclose(
        np.linalg.norm(features.normals(np.arange(valid.size)), axis=-1), valid.ravel(), atol=1e-5
    )
    # Toward the camera.
    assert (np.sum(raw[:, 3:6] * raw[:, 6:], axis=-1) < 0).all()


def test_normals_of_a_few_pixels_are_those_of_the_whole_image(cloud):
    valid = cloud.valid
    every = grid_features(cloud, CONFIG).normals(np.arange(valid.size)).reshape(*valid.shape, 3)
    for rows, columns in (
        (slice(0, 9), slice(0, 12)),
        (slice(20, 31), slice(30, 36)),
        (slice(-8, None), slice(-5, None)),
    ):
        some = np.arange(valid.size).reshape(valid.shape)[rows, columns]
        found = grid_features(cloud, CONFIG).normals(some.ravel())
        assert_allclose(found, every[rows, columns].reshape(-1, 3), atol=1e-5)


def test_places_without_a_point_are_joined_to_nothing(cloud):
    features = grid_features(cloud, CONFIG)
    valid, adjacency = features.grid.valid, features.adjacency
    assert not adjacency.right[~valid].any()
    assert not adjacency.down[~valid].any()
    assert not adjacency.right[:, -1].any()
    assert not adjacency.down[-1].any()
    assert adjacency.right[valid].mean() > 0.8


def test_the_smallest_segment_is_the_same_share_of_the_image_on_every_grid(cloud):
    every, second = (grid_features(cloud, replace(CONFIG, decimation=step)) for step in (1, 2))
    assert every.grid_pixels_min(CONFIG) == pytest.approx(4 * second.grid_pixels_min(CONFIG))


def test_a_frame_without_points_is_laid_out_too(cloud_of):
    features = grid_features(cloud_of(np.full((24, 32), np.nan)), CONFIG)
    assert not features.grid.valid.any()
    assert np.isfinite(features.normals(np.flatnonzero(features.grid.valid))).all()
