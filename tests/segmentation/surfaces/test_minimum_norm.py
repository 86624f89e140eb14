"""Fits of least norm compared with numpy's SVD of the whole design matrix, a row for each pixel."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from exact_surface import metric as exact_metric
from exact_surface import principal_curvatures as exact_curvatures
from numpy.linalg import LinAlgError
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy_basis import dense_solution

from nurbseg.segmentation.config import Metric, SegmentationConfig, Stag15Config
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.curvature import all_metrics, principal_curvatures
from nurbseg.segmentation.surfaces.fit import fit_surface
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS
from nurbseg.segmentation.surfaces.minimum_norm import minimum_norm_control_points


def ring() -> NDArray[np.bool_]:
    rows, columns = np.mgrid[:40, :50]
    radius = np.hypot(rows - 19.5, columns - 24.5)
    return (radius > 14) & (radius < 19)


def comb() -> NDArray[np.bool_]:
    """A block with one-pixel teeth, and a pixel by itself in the far corner."""
    mask = np.zeros((33, 61), dtype=bool)
    mask[:9, :40] = True
    mask[9:30, 3:40:9] = True
    mask[-1, -1] = True
    return mask


def scattered() -> NDArray[np.bool_]:
    mask = np.random.default_rng(8).random((47, 29)) < 0.04
    mask[0, 0] = mask[-1, -1] = True
    return mask


@pytest.mark.parametrize(
    ("mask", "nu", "nv", "full"),
    [
        (np.ones((30, 40), dtype=bool), 7, 5, True),
        (np.ones((31, 7), dtype=bool), 7, 4, True),
        (ring(), 10, 9, False),
        (comb(), 11, 6, False),
        (scattered(), 6, 11, False),
        (np.ones((5, 20), dtype=bool), 6, 5, True),
        (np.ones((1, 9), dtype=bool), 4, 4, False),
        (np.ones((9, 1), dtype=bool), 4, 4, False),
        (np.ones((1, 1), dtype=bool), 4, 4, False),
    ],
    ids=["full", "narrow", "ring", "comb", "scattered", "as many as rows", "row", "column", "pixel"],
)
def test_the_control_points_are_those_of_the_dense_svd(mask, nu: int, nv: int, full: bool):
    values = np.random.default_rng(1).normal(2.0, 0.1, (3, *mask.shape)).astype(np.float32)
    expected, _, rank = dense_solution(values.astype(float), mask, nu, nv, rcond=None)
    assert (rank == nu * nv) is full
    # Of an image of which the window is a part; what the mask leaves out is not read.
    images = np.full((3, mask.shape[0] + 3, mask.shape[1] + 2), np.nan, dtype=np.float32)
    images[:, 2:-1, 1:-1] = np.where(mask, values, np.nan)
    found = minimum_norm_control_points(images, mask, (2, 1), (nu, nv))
    # Singular values reach down to 1e-10 of the largest, and rounding up to so many times its size.
    assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_values_that_are_not_finite_have_no_solution():
    mask = np.ones((9, 9), dtype=bool)
    values = np.ones((1, 9, 9), dtype=np.float32)
    values[0, 4, 4] = np.inf
    with np.errstate(invalid="ignore"), pytest.raises(LinAlgError, match="not finite"):
        minimum_norm_control_points(values, mask, (0, 0), (4, 4))


def test_more_control_points_than_pixels_along_an_axis_are_refused():
    values, mask = np.ones((1, 5, 9), dtype=np.float32), np.ones((5, 9), dtype=bool)
    for counts in ((10, 4), (4, 6)):
        with pytest.raises(ValueError, match=r"at most \(9, 5\)"):
            minimum_norm_control_points(values, mask, (0, 0), counts)


def wavy_cloud(mask: NDArray[np.bool_], size: tuple[int, int] = (120, 160)) -> PointMap:
    """A noisy curved surface at 1 m, seen at the mask, which is put at row 30 and column 40."""
    rng = np.random.default_rng(6)
    rows, columns = np.mgrid[: size[0], : size[1]]
    depth = 1.0 + 0.03 * np.sin(columns / 9) * np.cos(rows / 7) + rng.normal(0, 0.001, size)
    points = np.stack([(columns - 80) / 140 * depth, (rows - 60) / 140 * depth, depth], axis=-1)
    valid = np.zeros(size, dtype=bool)
    valid[30 : 30 + mask.shape[0], 40 : 40 + mask.shape[1]] = mask
    points[~valid] = np.nan
    return PointMap(points.astype(np.float32), np.zeros((*size, 3), dtype=np.uint8), valid)


@pytest.mark.parametrize(("mask", "nu", "nv"), [(ring(), 5, 6), (comb(), 8, 6), (scattered(), 4, 8)])
def test_metrics_of_irregular_segments_are_those_of_the_dense_svd(mask, nu: int, nv: int):
    cloud, config = wavy_cloud(mask), SegmentationConfig(metric="vmxc")
    pixels, width = np.flatnonzero(cloud.valid), cloud.valid.shape[1]
    fit = fit_surface(cloud, pixels, config)
    assert fit.surface is not None
    assert fit.surface.weights.shape == (nv, nu)
    # The same knots, but for where they begin.
    top, left, bottom, right = fit.surface.window
    values = np.moveaxis(cloud.points_m[top:bottom, left:right].astype(float), -1, 0)
    own = cloud.valid[top:bottom, left:right]
    control = np.moveaxis(dense_solution(values, own, nu, nv, rcond=None)[0], 0, -1)
    dense = replace(fit, surface=replace(fit.surface, control_points_m=control))
    rows, columns = np.divmod(pixels, width)
    k1, k2 = exact_curvatures(dense.surface, columns, rows)
    found = principal_curvatures(fit.surface, columns, rows)
    scale = np.maximum(np.abs(k1), np.abs(k2))
    assert (np.abs(found - np.array([k1, k2])) <= 1e-4 * (1.0 + scale)).all()
    values = all_metrics(fit, width, config)
    expected = [exact_metric(name, dense, cloud, config) for name in CURVATURE_METRICS]
    assert_allclose([values[name] for name in CURVATURE_METRICS], expected, rtol=1e-4)


def test_fits_are_solved_as_the_setting_says():
    cloud = wavy_cloud(comb())
    pixels = np.flatnonzero(cloud.valid)

    def control(metric: Metric, least_squares) -> NDArray[np.float64]:
        fit = fit_surface(
            cloud, pixels, SegmentationConfig(metric=metric, stag15=Stag15Config(least_squares=least_squares))
        )
        assert fit.surface is not None
        return fit.surface.control_points_m

    svd, ridge = control("mse", "svd"), control("mse", "ridge")
    assert np.abs(svd - ridge).max() > 1.0
    for metric in get_args(Metric):
        assert_array_equal(control(metric, "auto"), svd if metric in CURVATURE_METRICS else ridge)
        assert_array_equal(control(metric, "svd"), svd)
        assert_array_equal(control(metric, "ridge"), ridge)
