import numpy as np
import pytest

from nurbseg.segmentation.borders import labels_of_every_pixel, refine_borders
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.inverse_depth import depth_grid, fit_window, inverse_depth_image

CONFIG = SegmentationConfig()


def fitted(cloud, truth):
    grid = depth_grid(cloud, 1)
    surfaces = []
    for label in range(1, truth.max() + 1):
        top, left, bottom, right = window = grid.points.locate(np.flatnonzero(truth == label))[2]
        mask = (truth == label)[top:bottom, left:right]
        surfaces.append(fit_window(grid, window, mask, CONFIG)[0].surface)
    return surfaces


@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_ragged_borders_return_to_where_the_surfaces_meet(cloud_of, box_on_table, noise):
    depth, truth = box_on_table(noise_per_m=noise)
    cloud = cloud_of(depth)
    rng = np.random.default_rng(0)
    # Labels of a place up to 3 pixels away.
    rows, columns = np.mgrid[: truth.shape[0], : truth.shape[1]]
    shift = rng.integers(-3, 4, (2, *truth.shape))
    ragged = truth[
        np.clip(rows + shift[0], 0, truth.shape[0] - 1), np.clip(columns + shift[1], 0, truth.shape[1] - 1)
    ].astype(np.int32)
    refined = refine_borders(ragged, inverse_depth_image(cloud), fitted(cloud, truth), CONFIG)
    assert (ragged != truth).mean() > 0.01
    assert (refined != truth).mean() < 0.25 * (ragged != truth).mean()
    assert ((refined > 0) == (truth > 0)).all()


def test_right_borders_stay(cloud_of, box_on_table):
    depth, truth = box_on_table()
    cloud = cloud_of(depth)
    refined = refine_borders(truth, inverse_depth_image(cloud), fitted(cloud, truth), CONFIG)
    assert (refined != truth).mean() < 3e-3


def test_no_label_loses_its_last_pixel(cloud_of, box_on_table):
    depth, truth = box_on_table()
    cloud = cloud_of(depth)
    labels = truth
    labels[120:122, 160:162] = 5
    surfaces = [*fitted(cloud, truth), None]
    refined = refine_borders(labels, inverse_depth_image(cloud), surfaces, CONFIG)
    assert set(np.unique(refined)) == {1, 2, 3, 4, 5}


def test_a_single_surface_is_left_alone():
    labels = np.ones((5, 6), np.int32)
    assert refine_borders(labels, np.ones((5, 6), np.float32), [None], CONFIG) is labels


@pytest.mark.parametrize("step", [1, 2, 3, 5])
def test_every_pixel_with_a_point_gets_the_label_of_its_surface(step):
    rng = np.random.default_rng(step)
    truth = np.where(np.arange(61) < 30, 1, 2)[np.newaxis].repeat(47, axis=0).astype(np.int32)
    per_m = np.where(truth == 1, np.float32(1.0), np.float32(1.3))
    valid = rng.random(truth.shape) < 0.9
    per_m[~valid] = 0.0
    on_grid = np.where(valid, truth, 0)[::step, ::step].astype(np.int32)
    labels = labels_of_every_pixel(
        on_grid, per_m[::step, ::step], per_m, valid, SegmentationConfig(decimation=step)
    )
    assert (labels == np.where(valid, truth, 0)).all()
