import numpy as np
import pytest

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.surfaces.metrics import (
    CURVATURE_METRICS,
    METRICS,
    acceptance_ratio,
    curvature_metrics,
    residual_metrics,
)


def test_residual_metrics_worked_by_hand():
    values = residual_metrics(np.array([0.0, 0.05, 0.1, 0.25]), SegmentationConfig())
    assert values["mse"] == pytest.approx((0.0025 + 0.01 + 0.0625) / 4)
    assert values["mae"] == pytest.approx(0.1)
    assert values["ve"] == pytest.approx((0.01 + 0.0025 + 0 + 0.0225) / 4)
    assert values["nle"] == 1, "an error of exactly T_l is not large"


def test_curvature_metrics_worked_by_hand():
    k1, k2 = np.array([1.0, 10.0, 30.0]), np.array([-3.0, 2.0, -20.0])
    values = curvature_metrics(k1, k2, SegmentationConfig())
    assert values["mmxc"] == pytest.approx((3 + 10 + 30) / 3)
    assert values["vmxc"] == pytest.approx(np.var([3, 10, 30]))
    assert values["vmec"] == pytest.approx(np.var([-1, 6, 5]))
    assert values["vgc"] == pytest.approx(np.var([-3, 20, -600]))
    assert values["nlc"] == 1, "a curvature of exactly T_c is not large"


def test_curvature_that_is_not_defined_is_left_out():
    values = curvature_metrics(
        np.array([2.0, np.nan, 9.0]), np.array([1.0, 7.0, np.nan]), SegmentationConfig()
    )
    assert values["mmxc"] == 2.0
    nowhere = curvature_metrics(np.full(3, np.nan), np.full(3, np.nan), SegmentationConfig())
    assert nowhere == dict.fromkeys(CURVATURE_METRICS, 0.0)


@pytest.mark.parametrize("metric", METRICS)
def test_ratios_weigh_means_by_size_and_add_counts(metric):
    ratio = acceptance_ratio(metric, (4.0, 100), (2.0, 75), (6.0, 25))
    assert ratio == pytest.approx((2 + 6) / 4 if metric in ("nle", "nlc") else (150 + 150) / 400)


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
