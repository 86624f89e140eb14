import numpy as np
import pytest
from numpy.testing import assert_allclose

from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.points.normals import facet_normals, facet_slopes

SIZE = (90, 120)
FOCAL = 0.8 * SIZE[1]


def seen(planes: np.ndarray) -> np.ndarray:
    """Depth at which rays meet planes n . p = 1, of normals (..., 3)."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    ray = np.stack([(columns - 59.5) / FOCAL, (rows - 44.5) / FOCAL, np.ones(SIZE)], axis=-1)
    return 1.0 / np.einsum("hwc,hwc->hw", ray, np.broadcast_to(planes, ray.shape))


def normals_of(cloud, step=1, noise=3e-3, window=9):
    grid = depth_grid(cloud, step)
    return facet_normals(
        grid.inverse_depth, grid.valid, grid.rays, step=step, window=window, noise_per_m=noise
    )


@pytest.mark.parametrize("step", [1, 2])
def test_a_plane_has_its_normal_everywhere(cloud_of, step):
    n = np.array([0.2, -0.5, 0.9])
    found = normals_of(cloud_of(seen(n)), step)
    assert_allclose(found, np.broadcast_to(-n / np.linalg.norm(n), found.shape), atol=4e-3)


def test_normals_keep_to_their_side_of_an_edge(cloud_of):
    left, right = np.array([0.5, 0.1, 0.8]), np.array([-0.9, 0.0, 0.9])
    planes = np.where(np.arange(120)[np.newaxis, :, np.newaxis] < 60, left, right)
    rng = np.random.default_rng(0)
    inverse_depth = 1 / seen(np.broadcast_to(planes, (*SIZE, 3))) + 1e-3 * rng.normal(size=SIZE)
    found = normals_of(cloud_of(1 / inverse_depth), noise=1e-3)
    expected = -planes / np.linalg.norm(planes, axis=-1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(np.sum(found * expected, axis=-1), -1, 1)))
    assert np.median(angles) < 2.0
    near = angles[6:-6, 56:64]
    # A window across the edge would be off by some 30 degrees here.
    assert np.quantile(near, 0.9) < 8.0


def test_a_ball_has_the_normals_of_a_ball(cloud_of):
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    ray = np.stack([(columns - 59.5) / FOCAL, (rows - 44.5) / FOCAL, np.ones(SIZE)], axis=-1)
    a, b, c = (ray**2).sum(axis=-1), ray[..., 2] * 2.0, 4.0 - 0.36
    root = b**2 - a * c
    depth = np.where(root > 0.1, (b - np.sqrt(np.maximum(root, 0))) / a, np.nan)
    cloud = cloud_of(depth)
    expected = (cloud.points_m - np.array([0, 0, 2.0])) / 0.6
    valid = cloud.valid
    found = normals_of(cloud, window=5, noise=3e-4)[valid]
    angles = np.degrees(np.arccos(np.clip(np.sum(found * expected[valid], axis=-1), -1, 1)))
    assert np.median(angles) < 3.0


def test_normals_point_to_the_camera_and_are_nothing_where_there_is_no_point(cloud_of):
    rng = np.random.default_rng(1)
    depth = 1.0 + 0.2 * rng.random(SIZE)
    depth[rng.random(SIZE) < 0.3] = np.nan
    cloud = cloud_of(depth)
    found = normals_of(cloud)
    assert (found[~cloud.valid] == 0).all()
    assert_allclose(np.linalg.norm(found[cloud.valid], axis=-1), 1.0, atol=1e-5)
    facing = np.sum(found * np.nan_to_num(cloud.points_m), axis=-1)[cloud.valid]
    assert (facing < 0).mean() > 0.99


def test_single_points_and_none_are_no_trouble():
    inverse_depth, valid = np.zeros(SIZE, np.float32), np.zeros(SIZE, bool)
    assert not facet_slopes(inverse_depth, valid, window=9, noise_per_m=3e-3)[0].any()
    inverse_depth[40, 50], valid[40, 50] = 1.0, True
    for image in facet_slopes(inverse_depth, valid, window=9, noise_per_m=3e-3):
        assert np.isfinite(image).all()


@pytest.mark.parametrize("shape", [(1, 40), (40, 1)])
def test_an_image_one_pixel_wide_has_normals_too(cloud_of, shape):
    depth = np.ones(shape)
    depth.flat[5:9] = np.nan
    cloud = cloud_of(depth)
    grid = depth_grid(cloud, 1)
    found = facet_normals(grid.inverse_depth, grid.valid, grid.rays, step=1, window=9, noise_per_m=3e-3)
    assert_allclose(np.linalg.norm(found, axis=-1), cloud.valid, atol=1e-6)


def test_planes_are_those_of_the_best_of_nine_windows_by_least_squares():
    shape, window, noise_per_m = (21, 26), 5, 2e-3
    rng = np.random.default_rng(4)
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    inverse_depth = np.where(columns + rows < 22, 0.9 + 0.01 * rows, 1.2 - 0.008 * columns)
    inverse_depth = (inverse_depth + rng.normal(0, noise_per_m, shape)).astype(np.float32)
    valid = rng.random(shape) < 0.7
    valid[3:9, 15:19] = False

    def around(y: int, x: int) -> tuple[float, float, float, float]:
        """Price of the plane in the window around a place, its value there and its slopes."""
        there = valid & (abs(rows - y) <= 2) & (abs(columns - x) <= 2)
        count = int(there.sum())
        if count < 0.3 * window**2:
            return np.inf, 0.0, 0.0, 0.0
        places, depths = np.column_stack([columns[there], rows[there]]), inverse_depth[there].astype(float)
        means, mean = places.mean(axis=0), depths.mean()
        # A hundredth of a square pixel is added to the variances of the places.
        system = np.vstack([places - means, 0.1 * np.sqrt(count) * np.eye(2)])
        values = np.append(depths - mean, [0.0, 0.0])
        slopes = np.linalg.lstsq(system, values, rcond=None)[0]
        variance = np.sum((values - system @ slopes) ** 2) / max(count - 3, 1)
        price = (variance + (0.3 * noise_per_m) ** 2) * (0.5 + 0.5 * window**2 / count)
        return price, mean + slopes @ ([x, y] - means), *slopes

    planes = {place: around(*place) for place in np.ndindex(shape)}
    own_best = 0
    slope_u, slope_v, smoothed = facet_slopes(inverse_depth, valid, window=window, noise_per_m=noise_per_m)
    for y, x in np.argwhere(valid):
        price, value, u, v = planes[y, x]
        best, expected = price / 1.5, (u, v, value)
        for down, across in ((a, b) for a in (-2, 0, 2) for b in (-2, 0, 2) if a or b):
            if (y + down, x + across) in planes:
                price, value, u, v = planes[y + down, x + across]
                value -= across * u + down * v
                if price < best and abs(inverse_depth[y, x] - value) <= 4.0 * noise_per_m:
                    best, expected = price, (u, v, value)
        own_best += expected == (*planes[y, x][2:], planes[y, x][1])
        if np.isfinite(best):
            assert (slope_u[y, x], slope_v[y, x], smoothed[y, x]) == pytest.approx(expected, abs=1e-5)
    # Both kinds occur.
    assert 0.2 * valid.sum() < own_best < 0.8 * valid.sum()
