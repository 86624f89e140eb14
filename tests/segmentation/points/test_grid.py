"""The step of the grid on which splits are decided, windows of some of its pixels, and its inverse depths."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nurbseg.segmentation.points.grid import (
    PixelGrid,
    decimated_grid,
    depth_grid,
    grid_step,
    inverse_depth_image,
    union,
)
from nurbseg.segmentation.points.registration import PointMap


@pytest.mark.parametrize(
    ("width", "decimation", "step"),
    [
        (320, 0, 1),
        (321, 0, 2),
        (640, 0, 2),
        (1280, 0, 4),
        (848, 0, 3),
        (424, 0, 2),
        (1920, 0, 6),
        (320, 2, 2),
        (320, 3, 3),
        (640, 1, 1),
    ],
)
def test_a_step_that_is_set_is_kept_and_else_small_images_keep_every_pixel(width, decimation, step):
    assert grid_step(np.ones((6, width), dtype=bool), decimation) == step


def test_a_grid_holds_a_point_where_the_image_does():
    valid = np.zeros((6, 640), dtype=bool)
    assert grid_step(valid, 3) == 3
    valid[1, 4] = True
    assert grid_step(valid, 3) == grid_step(valid, 0) == 1
    valid[2, 4] = True
    assert (grid_step(valid, 3), grid_step(valid, 0)) == (1, 2)


@pytest.mark.parametrize("share", [0.02, 0.5, 0.98, 1.0])
def test_the_window_of_some_grid_pixels_is_tight_and_marks_them(share):
    rng = np.random.default_rng(int(100 * share))
    grid = PixelGrid(1, (13, 17), np.zeros((3, 13, 17), dtype=np.float32), np.ones((13, 17), dtype=bool))
    for _ in range(20):
        there = rng.random((13, 17)) < share
        there[rng.integers(13), rng.integers(17)] = True
        rows, columns = np.nonzero(there)
        window, mask = grid.window_mask(np.flatnonzero(there))
        assert window == (rows.min(), columns.min(), rows.max() + 1, columns.max() + 1)
        top, left, bottom, right = window
        assert np.array_equal(mask, there[top:bottom, left:right])


@pytest.mark.parametrize("sizes", [(0, 0, 7), (1, 30, 0), (12, 12, 12)])
def test_parts_are_united_in_ascending_order(sizes):
    shuffled = np.random.default_rng(sum(sizes)).permutation(90)
    parts = [np.sort(part) for part in np.split(shuffled, np.cumsum(sizes))[:-1]]
    whole = union(parts)
    assert whole.tolist() == sorted(np.concatenate(parts).tolist())


@pytest.mark.parametrize("step", [1, 2, 3])
def test_grid_pixels_are_those_of_every_few_rows_and_columns(step):
    rng = np.random.default_rng(step)
    # Higher than wide, and of an odd width.
    valid = rng.random((31, 23)) < 0.8
    points_m = np.where(valid[..., np.newaxis], rng.random((31, 23, 3)), np.nan).astype(np.float32)
    grid = decimated_grid(PointMap(points_m, np.zeros((31, 23, 3), dtype=np.uint8), valid), step)
    assert np.array_equal(grid.valid, valid[::step, ::step])
    assert np.array_equal(grid.coordinates_m, np.nan_to_num(points_m[::step, ::step]).transpose(2, 0, 1))

    numbers = np.arange(grid.valid.size).reshape(grid.shape)
    some = np.sort(rng.choice(numbers.size, numbers.size // 3, replace=False))
    image = np.arange(valid.size).reshape(valid.shape)
    assert grid.every_second(some).tolist() == [n for n in some if n in numbers[::2, ::2]]
    pixels = image[::step, ::step].ravel()[some]
    assert np.array_equal(grid.pixels(some), pixels)
    assert grid.pixel_share == pytest.approx(valid.size / step**2 / (640 * 480))

    some = some[(some // grid.shape[1] >= 2) & (some % grid.shape[1] >= 3)]
    window, mask = grid.window_mask(some)
    assert (np.argwhere(mask) + window[:2] == np.stack(np.divmod(some, grid.shape[1]), axis=1)).all()
    rows, columns = np.divmod(image[::step, ::step].ravel()[some], 23)
    assert grid.full_window(window) == (rows.min(), columns.min(), rows.max() + 1, columns.max() + 1)


def test_only_points_in_front_of_the_camera_have_an_inverse_depth(cloud_of):
    rng = np.random.default_rng(0)
    points_m = rng.uniform(0.5, 3.0, (12, 17, 3)).astype(np.float32)
    points_m[rng.random((12, 17)) < 0.2] = np.nan
    points_m[2:6, 4, 2], points_m[2:6, 9, 2] = 0.0, -1.5
    other = cloud_of(np.ones((12, 17)))
    cloud = PointMap(points_m, other.color, other.colored, other.rays)
    in_front = points_m[..., 2] > 0
    expected = np.divide(1.0, points_m[..., 2], out=np.zeros((12, 17), np.float32), where=in_front)
    assert_allclose(inverse_depth_image(cloud), expected)
    grid = depth_grid(cloud, 3)
    assert_allclose(grid.inverse_depth, expected[::3, ::3])
    there = grid.valid
    assert_allclose(grid.distances_m[there], np.linalg.norm(points_m[::3, ::3][there], axis=1), rtol=1e-6)
