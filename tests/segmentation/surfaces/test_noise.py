from dataclasses import replace

import numpy as np
import pytest
from fitted import fit_of
from scipy.interpolate import BSpline
from scipy.ndimage import uniform_filter

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.points.grid import depth_grid
from nurbseg.segmentation.surfaces.curvature import principal_curvatures
from nurbseg.segmentation.surfaces.metrics import COUNTS, METRICS, curvature_metrics

SIZE = (240, 320)
#: Steps to a place and to its eight neighbors.
AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)]


def moved_by_noise(rays, inverse_depth, deviation_per_m, mask, draws=400):
    """Distances, meters, by which noise moves the marked points; three times the noise at the mask's rim."""
    rng = np.random.default_rng(0)
    held = np.pad(mask, 1)
    inner = np.all(
        [held[1 + i : held.shape[0] - 1 + i, 1 + j : held.shape[1] - 1 + j] for i, j in AROUND], axis=0
    )
    noise = deviation_per_m * np.where(inner, 1.0, 3.0) * rng.normal(size=(draws, *mask.shape))
    apart = rays / (inverse_depth + noise)[..., np.newaxis] - rays / inverse_depth[..., np.newaxis]
    return np.linalg.norm(apart, axis=-1)[:, mask]


@pytest.mark.parametrize("depth_m", [0.6, 1.2, 2.5])
def test_the_floor_is_what_noise_does_to_points_at_their_depth(cloud_of, rays_of_size, depth_m):
    rows, columns = np.mgrid[:60, :80]
    inverse_depth = 1 / depth_m + 0.001 * (columns - 40) - 0.0005 * (rows - 30)
    grid = depth_grid(cloud_of(1 / inverse_depth), 1)
    mask = (rows - 30) ** 2 + (columns - 40) ** 2 < 600
    for deviation_per_m, factor in ((1e-3, 1.0), (1e-3, 2.0), (3e-3, 0.5)):
        moved = moved_by_noise(rays_of_size((60, 80)), inverse_depth, factor * deviation_per_m, mask)
        expected = {
            "mse": np.mean(moved**2),
            "mae": np.mean(moved),
            # About each point's own mean: that of the depths is no error.
            "ve": np.mean(moved.var(axis=0)),
        }
        for metric, value in expected.items():
            config = SegmentationConfig(
                metric=metric,
                extended=ExtendedConfig(inverse_depth_noise=deviation_per_m, noise_floor=factor),
            )
            assert fit_of(grid, mask, config).floor == pytest.approx(value, rel=0.02)


def test_the_floor_of_large_errors_is_how_many_noise_makes(cloud_of, rays_of_size):
    inverse_depth = np.full((60, 80), 1 / 4.0)
    mask = np.ones((60, 80), dtype=np.bool_)
    moved = moved_by_noise(rays_of_size((60, 80)), inverse_depth, 2.2e-3, mask)
    config = SegmentationConfig(metric="nle", large_error_m=0.08)
    expected = np.mean(np.count_nonzero(moved > 0.08, axis=1))
    assert 100 < expected < 1000
    floor = fit_of(depth_grid(cloud_of(1 / inverse_depth), 1), mask, config).floor
    assert floor == pytest.approx(expected, rel=0.03)
    near = depth_grid(cloud_of(np.full((60, 80), 0.8)), 1)
    assert fit_of(near, mask, config).floor < 1e-6


@pytest.mark.parametrize("depth_m", [0.7, 1.5])
@pytest.mark.parametrize(
    ("extended", "large_per_m", "variance_tolerance"),
    [(ExtendedConfig(knot_spacing_px=50.0, smoothness=1.0), 0.05, 0.2), (ExtendedConfig(), 0.15, 0.3)],
    ids=["stiff", "default"],
)
def test_the_floor_of_curvature_is_that_of_surfaces_fitted_to_noise(
    cloud_of, depth_m, extended, large_per_m, variance_tolerance
):
    config = SegmentationConfig(
        large_curvature_per_m=large_per_m, extended=replace(extended, noise_correlation_px=1.0)
    )
    rng = np.random.default_rng(0)
    size = (240, 320)
    mask = np.ones(size, dtype=np.bool_)
    rows, columns = np.mgrid[80:160:4, 80:240:4].reshape(2, -1)
    curvatures = []
    for _ in range(40):
        cloud = cloud_of(1 / (1 / depth_m + config.extended.inverse_depth_noise * rng.normal(size=size)))
        # A step of 1 in an image half as wide as others: knots are as many grid pixels apart.
        fit = fit_of(depth_grid(cloud, 1), mask, config)
        curvatures.append(principal_curvatures(fit.surface, columns.astype(float), rows.astype(float)))
    k1, k2 = np.concatenate(curvatures, axis=1)
    expected = curvature_metrics(k1, k2, config)
    assert 0.05 < expected["nlc"] / k1.size < 0.5
    grid = depth_grid(cloud_of(np.full(size, depth_m)), 1)
    # The field is not the same between knots as at them, the less so the softer the surface. Variances of
    # what is no derivative itself notice that most.
    tolerances = {
        "mmxc": 0.05,
        "vmec": 0.1,
        "nlc": 0.1,
        "vmxc": variance_tolerance,
        "vgc": variance_tolerance,
    }
    for metric, tolerance in tolerances.items():
        floor = fit_of(grid, mask, replace(config, metric=metric)).floor
        points = mask.sum() / k1.size if metric == "nlc" else 1
        assert floor == pytest.approx(points * expected[metric], rel=tolerance), metric


@pytest.mark.parametrize(("spacing", "smoothness"), [(8.0, 0.1), (4.0, 2.0)])
def test_the_floor_of_curvature_follows_from_the_integrals_of_basis_functions(cloud_of, spacing, smoothness):
    cubic = BSpline.basis_element(np.arange(5.0), extrapolate=False)
    # Gauss's rule of four points is exact on each span.
    nodes, weights = np.polynomial.legendre.leggauss(4)
    at = (np.arange(4)[:, np.newaxis] + 0.5 + 0.5 * nodes).ravel()

    def spectrum(order):
        """Of the integrals of products of derivatives, of functions on a circle of 64 knots."""
        one, row = cubic(at, nu=order), np.zeros(64)
        for apart in range(-3, 4):
            other = np.nan_to_num(cubic(at - apart, nu=order))
            row[apart] = np.tile(0.5 * weights, 4) @ (one * other)
        return np.fft.fft(row).real * spacing ** (1 - 2 * order)

    values, slopes, curvatures = (spectrum(order) for order in range(3))
    penalty = np.abs(np.fft.fft([1.0, -2.0, 1.0], 64)) ** 2
    G, P = np.outer(values, values), smoothness * np.add.outer(penalty, penalty)
    bent = np.outer(slopes, slopes) + np.outer(curvatures, values)
    variance = np.mean(G * bent / (G + P) ** 2) / (4.0 * spacing**2)
    # A pixel is two of a 640-wide image, and the focal length 256 pixels.
    knots = {"knot_spacing_px": 2.0 * spacing, "smoothness": smoothness}
    extended = ExtendedConfig(**knots, noise_correlation_px=1.0, inverse_depth_noise=1e-3)
    grid, mask = depth_grid(cloud_of(np.ones(SIZE)), 1), np.ones(SIZE, dtype=np.bool_)
    floor = fit_of(grid, mask, SegmentationConfig(metric="vmec", extended=extended)).floor
    assert floor == pytest.approx(2.0 * (1e-3 * 256.0**2) ** 2 * variance, rel=1e-4)


def test_noise_that_neighbouring_pixels_share_bends_surfaces_more(cloud_of):
    """Averages of squares of white noise, of the same deviation: much more of it is at low frequencies."""
    stiff, rng, mask = (
        ExtendedConfig(knot_spacing_px=80.0),
        np.random.default_rng(0),
        np.ones(SIZE, dtype=bool),
    )
    rows, columns = np.mgrid[80:160:4, 80:240:4].reshape(2, -1).astype(float)
    for side in (1, 6, 12):
        # A pixel is two of a 640-wide image.
        extended = replace(stiff, noise_correlation_px=2.0 * side)
        config = SegmentationConfig(metric="vmec", extended=extended)
        curvatures = []
        for _ in range(40):
            noise = side * uniform_filter(rng.normal(size=SIZE), side, mode="wrap")
            cloud = cloud_of(1 / (1.0 + extended.inverse_depth_noise * noise))
            fit = fit_of(depth_grid(cloud, 1), mask, config)
            curvatures.append(principal_curvatures(fit.surface, columns, rows))
        expected = curvature_metrics(*np.concatenate(curvatures, axis=1), config)["vmec"]
        floor = fit_of(depth_grid(cloud_of(np.ones(SIZE)), 1), mask, config).floor
        assert floor == pytest.approx(expected, rel=0.15), side


def test_the_floor_of_curvature_is_the_same_on_every_second_pixel_of_twice_as_many(cloud_of):
    config = SegmentationConfig(metric="vmec")
    mask = np.ones((60, 80), dtype=np.bool_)
    small, large = depth_grid(cloud_of(np.ones((60, 80))), 1), depth_grid(cloud_of(np.ones((120, 160))), 2)
    # The same points but for half a pixel, the same knots, the same smoothness.
    floors = [fit_of(grid, mask, config).floor for grid in (small, large)]
    assert floors[0] == pytest.approx(floors[1], rel=1e-9)


@pytest.mark.parametrize("metric", METRICS)
def test_the_floors_of_parts_sum_to_at_least_that_of_the_whole(cloud_of, metric):
    rng = np.random.default_rng(1)
    grid = depth_grid(cloud_of(rng.uniform(0.5, 4.0, (40, 50))), 1)
    config = SegmentationConfig(metric=metric, large_error_m=0.03, large_curvature_per_m=0.05)
    for _ in range(20):
        whole = rng.random((40, 50)) < 0.97
        side = whole & (np.add.outer(np.arange(40), np.arange(50)) < rng.integers(15, 70))
        floors, counts = [], []
        for mask in (whole, side, whole & ~side):
            floors.append(fit_of(grid, mask, config).floor)
            counts.append(1 if metric in COUNTS else np.count_nonzero(mask))
        assert floors[0] > 0
        assert floors[1] * counts[1] + floors[2] * counts[2] >= floors[0] * counts[0] * (1 - 1e-12)
