from dataclasses import replace

import numpy as np
import pytest
from fitted import fit_of
from numpy.testing import assert_allclose
from scipy_basis import scipy_basis

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.surfaces.surface import evaluate

SIZE = (60, 80)
CONFIG = SegmentationConfig(decimation=1)


def plane(slope_u: float = 0.004, slope_v: float = -0.003) -> np.ndarray:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    return 1.0 / (0.8 + slope_u * columns + slope_v * rows)


def test_a_plane_is_fitted_exactly(cloud_of):
    cloud = cloud_of(plane())
    fit = fit_of(depth_grid(cloud, 1), cloud.valid, CONFIG)
    assert fit.residuals_m.max() < 1e-6
    points = evaluate(fit.surface, np.arange(80.0), np.arange(60.0)[:, np.newaxis])
    assert_allclose(points, cloud.points_m, atol=2e-6)


def test_a_plane_is_extrapolated_beyond_its_segment(cloud_of):
    cloud = cloud_of(plane())
    mask = np.zeros(SIZE, dtype=bool)
    mask[20:40, 30:45] = True
    fit = fit_of(depth_grid(cloud, 1), mask, CONFIG)
    points = evaluate(fit.surface, np.arange(27.0, 48), np.arange(17.0, 43)[:, np.newaxis])
    assert_allclose(points, cloud.points_m[17:43, 27:48], atol=1e-4)


def test_the_surface_is_the_ray_over_the_spline(cloud_of):
    rng = np.random.default_rng(0)
    cloud = cloud_of(plane() + 0.05 * rng.normal(size=SIZE))
    surface = fit_of(depth_grid(cloud, 1), cloud.valid, CONFIG).surface
    u, v = rng.uniform(0, 79, 200), rng.uniform(0, 59, 200)
    Bu, Bv = scipy_basis(surface.knots_u, 3, u), scipy_basis(surface.knots_v, 3, v)
    d = np.einsum("na,ab,nb->n", Bv, surface.weights, Bu)
    x, y = cloud.rays.at(u, v)
    assert_allclose(evaluate(surface, u, v), np.stack([x, y, np.ones(200)], axis=1) / d[:, np.newaxis])


@pytest.mark.parametrize("step", [1, 2])
def test_residuals_are_distances_to_the_surface_that_is_returned(cloud_of, step):
    rng = np.random.default_rng(1)
    depth = plane() + 0.01 * rng.normal(size=SIZE)
    depth[rng.random(SIZE) < 0.2] = np.nan
    cloud = cloud_of(depth)
    config = SegmentationConfig(decimation=step, large_error_m=0.01)
    grid = depth_grid(cloud, step)
    fit = fit_of(grid, grid.valid, config)
    rows, columns = np.divmod(fit.pixels, SIZE[1])
    points = cloud.points_m[rows, columns]
    on_surface = evaluate(fit.surface, columns.astype(float), rows.astype(float))
    assert_allclose(fit.residuals_m, np.linalg.norm(points - on_surface, axis=1), atol=2e-6)
    residuals = 1 / on_surface[:, 2] - 1 / points[:, 2]
    large = np.count_nonzero(fit.residuals_m > 0.01)
    assert 0.1 < large / fit.residuals_m.size < 0.9
    moments = {"mse": np.mean(fit.residuals_m**2), "mae": fit.residuals_m.mean(), "ve": fit.residuals_m.var()}
    assert fit.values == pytest.approx({**moments, "nle": large})
    # Some residuals are beyond four times the noise, others are not.
    limited = np.minimum(np.abs(residuals), 4 * config.extended.inverse_depth_noise)
    assert 0.1 < np.mean(limited < np.abs(residuals)) < 0.9
    assert fit.rms_per_m == pytest.approx(np.sqrt(np.mean(limited**2)))


@pytest.mark.parametrize("bent", [0.0, 0.05])
def test_points_of_a_fitted_surface_are_on_the_rays_of_their_pixels(cloud_of, bent):
    cloud = cloud_of(plane())
    rays = cloud.rays
    assert rays.linear
    if bent:
        coefficients = np.zeros((2, 6, 6))
        coefficients[:, :2, :2] = rays.coefficients
        coefficients[:, 2, 1] = bent
        rays = replace(rays, coefficients=coefficients)
        assert not rays.linear
    grid = replace(depth_grid(cloud, 2), rays=rays)
    surface = fit_of(grid, grid.valid, CONFIG).surface
    u, v = np.linspace(0, 78, 13), np.linspace(0, 58, 13)
    x, y, z = evaluate(surface, u, v).T
    assert_allclose([x / z, y / z], rays.at(u, v), atol=1e-4)
    assert_allclose(1.0 / z, 0.8 + 0.004 * u - 0.003 * v, atol=1e-5)


@pytest.mark.parametrize("depth_is_known", [True, False])
def test_pixels_of_a_fit_are_those_of_the_marked_grid_pixels_in_the_image(cloud_of, depth_is_known):
    grid = depth_grid(cloud_of(plane()), 2)
    if not depth_is_known:
        grid = replace(grid, inverse_depth=np.full((30, 40), np.nan, np.float32))
    mask = np.random.default_rng(2).random((30, 40)) < 0.6
    fit = fit_of(grid, mask, CONFIG)
    assert (fit.surface is not None) == depth_is_known
    image = np.arange(SIZE[0] * SIZE[1]).reshape(SIZE)
    assert fit.pixels.tolist() == image[::2, ::2][mask].tolist()


def test_a_surface_reaches_beyond_its_window_as_far_at_any_size_of_the_image(cloud_of):
    shares = []
    for n, step in ((1, 1), (2, 1), (2, 2)):
        grid, size = depth_grid(cloud_of(np.ones((80 * n, 160 * n))), step), n // step
        mask = np.zeros(grid.shape, dtype=bool)
        mask[30 * size : 40 * size, 60 * size : 74 * size] = True
        surface = fit_of(grid, mask, CONFIG).surface
        (left, right), (top, bottom) = (each[[3, -4]] for each in (surface.knots_u, surface.knots_v))
        shares.append(np.array([60 * n - left, 30 * n - top]) / (160 * n))
        assert min(right - 73 * n, bottom - 39 * n, *shares[-1] * 160 * n) > 0.03 * 160 * n
    assert np.ptp(shares, axis=0) == pytest.approx([0.0, 0.0])


def test_a_surface_never_passes_through_infinity_where_nothing_holds_it(cloud_of):
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    inverse_depth = np.where(columns < 12, 1.6 - 0.13 * columns, 0.05)
    cloud = cloud_of(1 / inverse_depth)
    mask = (columns < 12) | ((rows < 3) & (columns > 70))
    fit = fit_of(depth_grid(cloud, 1), mask, CONFIG)
    assert (fit.surface.weights > 0).all()
    assert np.isfinite(evaluate(fit.surface, np.arange(80.0), np.arange(60.0)[:, np.newaxis])).all()


def test_points_that_are_nowhere_leave_no_surface_but_a_reason(cloud_of):
    cloud = cloud_of(plane())
    grid = depth_grid(cloud, 1)
    broken = replace(grid, inverse_depth=np.full(SIZE, np.nan, np.float32))
    fit = fit_of(broken, cloud.valid, CONFIG)
    assert fit.surface is None
    assert "least-squares" in fit.reason
