"""Fits compared with the dense system of the paper: one row for each point, solved by SVD."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy_basis import dense_solution, dense_system, pixel_basis

from nurbseg.segmentation.surfaces import leastsquares


def fit_control_points(values, mask: NDArray[np.bool_], counts: tuple[int, int]) -> NDArray[np.float64]:
    """Fit single precision images of a window that is not the first of its image."""
    images = np.full((len(values), mask.shape[0] + 3, mask.shape[1] + 2), np.nan, dtype=np.float32)
    images[:, 2:-1, 1:-1] = values
    return leastsquares.fit_control_points(images, mask, (2, 1), counts)


def single(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round to single precision, in which images are."""
    return values.astype(np.float32).astype(np.float64)


def ring(seed: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Noise on a ring: control points in its middle and in the corners have no data, or hardly any."""
    rows, columns = np.mgrid[:40, :50]
    radius = np.hypot(rows - 19.5, columns - 24.5)
    mask = (radius > 14) & (radius < 19)
    return single(np.random.default_rng(seed).normal(2.0, 0.1, (3, 40, 50))), mask


@pytest.mark.parametrize(("height", "width", "nu", "nv"), [(30, 40, 7, 5), (40, 30, 5, 9), (12, 60, 11, 4)])
def test_a_full_window_has_the_control_points_of_the_dense_system(height, width, nu, nv):
    rng = np.random.default_rng(3)
    values = single(rng.normal(1.0, 0.3, (3, height, width)))
    mask = np.ones((height, width), dtype=bool)
    expected, _, rank = dense_solution(values, mask, nu, nv)
    assert rank == nu * nv
    assert_allclose(fit_control_points(values, mask, (nu, nv)), expected, atol=1e-7)


def test_an_irregular_mask_leaves_the_residuals_of_the_dense_system():
    values, mask = ring(4)
    _, expected, rank = dense_solution(values, mask, 10, 9)
    assert rank < 90
    control = fit_control_points(values, mask, (10, 9))
    ours = (pixel_basis(40, 9) @ control @ pixel_basis(50, 10).T)[:, mask]
    rms, least_rms = (np.sqrt(np.mean((fitted - values[:, mask]) ** 2)) for fitted in (ours, expected))
    # White noise is the worst case: what hardly any data decide, the ridge holds back.
    assert least_rms <= rms <= 1.02 * least_rms


def test_what_the_data_leave_open_stays_at_the_mean():
    values, mask = ring(5)
    control = fit_control_points(values, mask, (10, 9))
    without_data = ~dense_system(mask, 10, 9).any(axis=0).reshape(9, 10)
    assert without_data.sum() > 3
    means = values[:, mask].mean(axis=1)
    assert_allclose(control[:, without_data], np.tile(means, (without_data.sum(), 1)).T, atol=1e-12)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 3)])
def test_windows_smaller_than_the_basis_are_interpolated(shape):
    rng = np.random.default_rng(6)
    values = single(rng.normal(size=(3, *shape)))
    mask = np.ones(shape, dtype=bool)
    control = fit_control_points(values, mask, (4, 4))
    fitted = pixel_basis(shape[0], 4) @ control @ pixel_basis(shape[1], 4).T
    _, expected, _ = dense_solution(values, mask, 4, 4)
    assert_allclose(fitted[:, mask], expected, atol=1e-5)
