import numpy as np
import pytest

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.surfaces.metrics import (
    CURVATURE_METRICS,
    acceptance_ratio,
    curvature_metrics,
    residual_metrics,
)


def test_what_is_exactly_at_a_limit_is_not_large():
    config = SegmentationConfig()
    errors, curvatures = np.array([0.0, 0.05, 0.1, 0.25]), np.array([1.0, 10.0, -30.0])
    assert residual_metrics(errors, config) == pytest.approx(
        {"mse": 0.01875, "mae": 0.1, "ve": 0.00875, "nle": 1}
    )
    assert curvature_metrics(curvatures, 0 * curvatures, config)["nlc"] == 1


def test_curvature_that_is_not_defined_is_left_out():
    values = curvature_metrics(
        np.array([2.0, np.nan, 9.0]), np.array([1.0, 7.0, np.nan]), SegmentationConfig()
    )
    assert values["mmxc"] == 2.0
    nowhere = curvature_metrics(np.full(3, np.nan), np.full(3, np.nan), SegmentationConfig())
    assert nowhere == dict.fromkeys(CURVATURE_METRICS, 0.0)


def test_what_is_zero_cannot_improve():
    assert acceptance_ratio("mse", (0.0, 100), (0.0, 50), (0.0, 50)) == np.inf
    assert acceptance_ratio("nle", (0.0, 100), (0.0, 50), (0.0, 50)) == np.inf
    assert acceptance_ratio("mse", (1.0, 0), (0.0, 0), (0.0, 0)) == np.inf
    assert acceptance_ratio("mse", (1.0, 1), (0.5, 1)) == 0.5


def test_residuals_that_are_rounding_count_as_none():
    rounding = residual_metrics(np.array([0.0, 1e-6]), SegmentationConfig())
    assert rounding == {"mse": 0.0, "mae": 0.0, "ve": 0.0, "nle": 0.0}
    # All together or not at all.
    assert residual_metrics(np.array([0.0, 1.1e-6]), SegmentationConfig())["mae"] == 0.55e-6


def test_no_points_have_no_error():
    assert set(residual_metrics(np.zeros(0), SegmentationConfig()).values()) == {0.0}
