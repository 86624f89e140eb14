import numpy as np
import pytest

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.borders import refine_borders
from nurbseg.segmentation.points.grid import depth_grid, inverse_depth_image
from nurbseg.segmentation.surfaces.inverse_depth import fit_window
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

CONFIG = SegmentationConfig()


def fitted(cloud, truth):
    grid = depth_grid(cloud, 1)
    surfaces = []
    for label in range(1, truth.max() + 1):
        top, left, bottom, right = window = grid.window_mask(np.flatnonzero(truth == label))[0]
        mask = (truth == label)[top:bottom, left:right]
        surfaces.append(fit_window(grid, window, mask, CONFIG).surface)
    return surfaces


@pytest.mark.parametrize("step", [1, 2])
@pytest.mark.parametrize("noise", [0.0, 2e-3])
def test_ragged_borders_return_to_where_the_surfaces_meet(cloud_of, box_on_table, noise, step):
    depth, truth = box_on_table(noise_per_m=noise)
    cloud = cloud_of(depth)
    rng = np.random.default_rng(0)
    # Labels of a place up to 3 pixels away.
    rows, columns = np.mgrid[: truth.shape[0], : truth.shape[1]]
    shift = rng.integers(-3, 4, (2, *truth.shape))
    ragged = truth[
        np.clip(rows + shift[0], 0, truth.shape[0] - 1), np.clip(columns + shift[1], 0, truth.shape[1] - 1)
    ].astype(np.int32)
    surfaces, inverse_depth = fitted(cloud, truth), inverse_depth_image(cloud)
    ragged, truth, inverse_depth = (each[::step, ::step] for each in (ragged, truth, inverse_depth))
    refined = refine_borders(
        ragged, inverse_depth, SurfaceTable(surfaces), CONFIG, rms_per_m=[0.0] * len(surfaces), step=step
    )
    assert (ragged != truth).mean() > 0.01
    assert (refined != truth).mean() < 0.25 * (ragged != truth).mean()
    assert ((refined > 0) == (truth > 0)).all()


def test_right_borders_stay(cloud_of, box_on_table):
    depth, truth = box_on_table()
    cloud = cloud_of(depth)
    surfaces = SurfaceTable(fitted(cloud, truth))
    refined = refine_borders(truth, inverse_depth_image(cloud), surfaces, CONFIG, rms_per_m=[0.0] * 4)
    assert (refined != truth).mean() < 3e-3


def test_no_label_loses_its_last_pixel(cloud_of, box_on_table):
    depth, truth = box_on_table()
    cloud = cloud_of(depth)
    # Of the last label, and of one before it.
    surfaces = [*fitted(cloud, truth), None, None]
    for label in (5, 6):
        truth[120:122, 40 * label : 40 * label + 2] = label
    table, rms_per_m = SurfaceTable(surfaces), [0.0] * 6
    refined = refine_borders(truth, inverse_depth_image(cloud), table, CONFIG, rms_per_m=rms_per_m)
    assert set(np.unique(refined)) == {1, 2, 3, 4, 5, 6}


@pytest.mark.parametrize("spread_severed", [True, False])
def test_what_a_border_cuts_off_goes_to_its_neighbors_if_it_is_small(spread_severed):
    labels = np.ones((240, 320), np.int32)
    labels[:, 200:] = 2
    # A quarter of the settings' pixels: at least 30.
    labels[20:25, 20:25], labels[50:56, 20:26] = 2, 2
    refined = refine_borders(
        labels,
        np.ones(labels.shape, np.float32),
        SurfaceTable([None, None]),
        CONFIG,
        rms_per_m=[0.0, 0.0],
        sweeps=0,
        spread_severed=spread_severed,
    )
    expected = labels.copy()
    if spread_severed:
        expected[20:25, 20:25] = 1
    assert (refined == expected).all()


def test_a_single_surface_is_left_alone():
    labels = np.ones((5, 6), np.int32)
    inverse_depth = np.ones((5, 6), np.float32)
    assert refine_borders(labels, inverse_depth, SurfaceTable([None]), CONFIG, rms_per_m=[0.0]) is labels
