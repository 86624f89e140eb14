"""The metrics of a surface fit and their acceptance ratios (section 4)."""

from typing import get_args

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, compiled, inlined
from nurbseg.segmentation.config import METRIC_UNITS, OUTLIER_DEVIATIONS, Metric, SegmentationConfig

METRICS: tuple[Metric, ...] = get_args(Metric)
COUNTS: frozenset[Metric] = frozenset(each for each in METRICS if METRIC_UNITS[each] == "points")
#: Metrics of residuals alone.
RESIDUAL_METRICS: tuple[Metric, ...] = ("mse", "mae", "ve", "nle")
#: Metrics that need the curvature of the surface.
CURVATURE_METRICS: tuple[Metric, ...] = ("vmxc", "vmec", "vgc", "mmxc", "nlc")
#: Rounding of residuals, meters: points are stored in single precision.
ROUNDING_M = 1e-6
#: A squared residual in units of the noise counts as no more than this, so that flying pixels do not decide.
SQUARE_MOST = OUTLIER_DEVIATIONS**2


def residual_metrics(residuals_m: NDArray[np.float64], config: SegmentationConfig) -> dict[Metric, float]:
    """Compute the metrics of residuals (eq. 7, 9, 11 and section 4.4).

    Parameters
    ----------
    residuals_m : (N,) float64
        Distances of the points to the surface, meters.
    config : SegmentationConfig
        Its `large_error_m` is T_l.

    Returns
    -------
    dict
        ``mse`` and ``ve`` in square meters, ``mae`` in meters, ``nle`` a count. Residuals that are no
        more than the rounding of the points count as 0, all together or not at all.
    """
    return dict(zip(RESIDUAL_METRICS, _metrics(residuals_m, config.large_error_m), strict=True))


@compiled
def _metrics(residuals_m: F64, large_m: float) -> tuple[float, float, float, float]:
    largest, total, squares, large = 0.0, 0.0, 0.0, 0
    for residual in residuals_m:
        largest = max(largest, residual)
        squares += residual * residual
        total += residual
        large += residual > large_m
    return metrics_of_sums(residuals_m.size, largest, total, squares, large)


@inlined
def metrics_of_sums(
    count: int, largest: float, total: float, squares: float, large: int
) -> tuple[float, float, float, float]:
    """Return the residual metrics from the largest, their sum, that of squares, and how many are large."""
    if largest <= ROUNDING_M:
        return 0.0, 0.0, 0.0, 0.0
    mse, mae = squares / count, total / count  # eq. 7, 9
    # Eq. 11, the mean of the squares less the square of the mean; section 4.4.
    return mse, mae, max(mse - mae * mae, 0.0), float(large)


def curvature_metrics(
    k1: NDArray[np.float64], k2: NDArray[np.float64], config: SegmentationConfig
) -> dict[Metric, float]:
    """Compute the metrics of curvature (eq. 14, 15, 17, 19 and section 4.9).

    Parameters
    ----------
    k1, k2 : (N,) float64
        Principal curvatures at the points, 1/m; NaN is left out.
    config : SegmentationConfig
        Its `large_curvature_per_m` is T_c.

    Returns
    -------
    dict
        ``vmxc`` and ``vmec`` in 1/m^2, ``vgc`` in 1/m^4, ``mmxc`` in 1/m, ``nlc`` a count.
    """
    defined = np.isfinite(k1) & np.isfinite(k2)
    k1, k2 = k1[defined], k2[defined]
    if k1.size == 0:
        return dict.fromkeys(CURVATURE_METRICS, 0.0)
    largest = np.maximum(np.abs(k1), np.abs(k2))  # kappa_max
    return {
        "vmxc": float(largest.var()),  # eq. 14
        "vmec": float((0.5 * (k1 + k2)).var()),  # eq. 17
        "vgc": float((k1 * k2).var()),  # eq. 19
        "mmxc": float(largest.mean()),  # eq. 15
        "nlc": float(np.count_nonzero(largest > config.large_curvature_per_m)),  # section 4.9
    }


def acceptance_ratio(metric: Metric, parent: tuple[float, int], *parts: tuple[float, int]) -> float:
    """Compare a metric after a split with the one before it (eq. 5, 8, 10, 12, 13, 16, 18, 20-22).

    Parameters
    ----------
    metric : str
        Which one.
    parent, *parts : (float, int)
        Value and number of points of the segment and of each of its parts, two in the paper.

    Returns
    -------
    float
        Below 1 if the split improves the metric; inf if the parent's value is 0, which no split can improve.
    """
    if not parent[0] > 0 or parent[1] == 0:
        return float(np.inf)
    if metric in COUNTS:
        return sum(value for value, _ in parts) / parent[0]  # eq. 13, 22
    # Eq. 5, which is eq. 8, 10, 12, 16, 18, 20 and 21 of each metric.
    return sum(value * points for value, points in parts) / (parent[0] * parent[1])
