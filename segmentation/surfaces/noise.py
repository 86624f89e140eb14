"""The effect of sensor noise, constant in inverse depth for triangulating cameras, on metrics."""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, Bool, compiled, inlined
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.points.grid import DepthGrid, Window
from nurbseg.segmentation.surfaces.inverse_depth import knots_on
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS

#: Factor on the noise at a segment's rim, where points are often mixed with the background.
_RIM_FACTOR = 3.0


def noise_floor(
    grid: DepthGrid, window: Window, mask: NDArray[np.bool_], config: SegmentationConfig
) -> float:
    """Return the value of the deciding metric that noise alone explains, the least it counts for in eq. 5.

    Noise of inverse depth with deviation s moves a point at depth z and distance |p| by s z |p| along its
    ray. Residual metrics are those expected of normal noise of that size at the segment's points; curvature
    metrics are those of a surface fitted to a noisy plane that faces the camera.

    The floor times the number of points (for counts, the floor) is a sum over points. No point contributes
    less in a part than in the whole, since rim points remain at the rim. So the ratio of any split is at
    least the floor of the whole over its value.

    Parameters
    ----------
    grid, window, mask
        As for `nurbseg.segmentation.surfaces.inverse_depth.fit_window`.
    config : SegmentationConfig
        The metric, T_l and T_c, the noise and its factor `noise_floor`, and the knots of the surfaces.

    Returns
    -------
    float
        In the unit of the metric.
    """
    if config.metric in CURVATURE_METRICS:
        return _curvature_floor(int(np.count_nonzero(mask)), grid, config)
    sums = _sum_noise(grid.inverse_depth, grid.distances_m, mask, window[:2], *_deviation_and_limit(config))
    return _floor(sums, config)


def _deviation_and_limit(config: SegmentationConfig) -> tuple[float, float]:
    """Return the deviation of inverse depth, 1/m, and the limit of large errors, meters, 0 if none count."""
    limit_m = config.large_error_m if config.metric == "nle" else 0.0
    return config.extended.noise_floor * config.extended.inverse_depth_noise, limit_m


def _floor(sums: Sequence[float], config: SegmentationConfig) -> float:
    """Return the floor of a residual metric, from sums of the noise of points."""
    count, total, squares, large = sums
    mean, mean_square = total / max(count, 1.0), squares / max(count, 1.0)
    floors: dict[Metric, float] = {
        "mse": mean_square,
        # The absolute value of a normal variable: its mean, and its variance, in units of the deviation.
        "mae": mean * math.sqrt(2.0 / math.pi),
        "ve": mean_square * (1.0 - 2.0 / math.pi),
        "nle": large,
    }
    return floors[config.metric]


@compiled
def _sum_noise(
    inverse_depth: F32, distances_m: F32, mask: Bool, corner: tuple[int, int], scale: float, large_m: float
) -> tuple[float, float, float, float]:
    """Count marked pixels; sum their noise in meters, its square, and its probability to exceed a limit."""
    (top, left), (height, width) = corner, mask.shape
    inner, noise_m = np.zeros((2, width), dtype=np.bool_), np.empty(width)
    count, total, squares, large = 0.0, 0.0, 0.0, 0.0
    for y in range(height):
        depths, distances = inverse_depth[top + y, left:], distances_m[top + y, left:]
        _fill_noise(depths, distances, mask, y, scale, inner, noise_m)
        for x in range(width):
            noise = noise_m[x] if mask[y, x] else 0.0
            count += mask[y, x]
            total += noise
            squares += noise * noise
        if large_m > 0.0:
            for x in range(width):
                if mask[y, x]:
                    large += math.erfc(large_m / (math.sqrt(2.0) * noise_m[x]))
    return count, total, squares, large


@inlined
def _fill_noise(
    inverse_depth: F32,
    distances_m: F32,
    labels: NDArray[Any],
    y: int,
    scale: float,
    inner: Bool,
    noise_m: F64,
) -> None:
    """Fill in the noise of a row, meters, of deviation `scale` in 1/m; `inner` is memory for two rows.

    Simple loops are vectorized.
    """
    height, width = labels.shape
    row, above, below = labels[y], labels[max(y - 1, 0)], labels[min(y + 1, height - 1)]
    within, three = 0 < y < height - 1, inner[1]
    for x in range(width):
        three[x] = within & (above[x] == row[x]) & (below[x] == row[x])
    for x in range(1, width - 1):
        alike = (row[x - 1] == row[x]) & (row[x + 1] == row[x])
        inner[0, x] = alike & three[x - 1] & three[x] & three[x + 1]
    for x in range(width):
        rim = 1.0 if inner[0, x] else _RIM_FACTOR
        noise_m[x] = scale * distances_m[x] / inverse_depth[x] * rim


def _curvature_floor(points: int, grid: DepthGrid, config: SegmentationConfig) -> float:
    """Return the floor of a curvature metric, from a plane that faces the camera.

    Its curvature is, but for the sign, f^2 times the second derivatives of inverse depth, at any depth. For
    an isotropic normal field these are three independent normal variables: the mean curvature H of variance
    2 t, and two of variance t, whose length R is half the difference of the principal curvatures. So the
    largest absolute curvature is |H| + R, and the Gaussian curvature H^2 - R^2.
    """
    fx, fy = grid.rays.focal_px
    scale = _deviation_and_limit(config)[0] * fx * fy / grid.step**2
    t = scale * scale * _second_derivative_variance(*knots_on(grid, config))
    # At the low frequencies that a surface follows, noise that is alike on so many grid pixels has as many
    # times the power of white noise.
    t *= max(1.0, config.extended.noise_correlation_px * grid.unit_px / grid.step) ** 2
    if not 0.0 < t < np.inf:
        return 0.0
    most = config.large_curvature_per_m / math.sqrt(t)
    beyond = math.erf(most / math.sqrt(12.0)) + math.erf(most / math.sqrt(3.0))
    floors: dict[Metric, float] = {
        "vmxc": (4.0 - 4.0 / math.pi - math.pi / 2.0) * t,
        "vmec": 2.0 * t,
        "vgc": 12.0 * t * t,
        "mmxc": (2.0 / math.sqrt(math.pi) + math.sqrt(math.pi / 2.0)) * math.sqrt(t),
        # P(|H| + R > T_c), by integration over H.
        "nlc": points * (math.erfc(most / 2.0) + math.exp(-most * most / 6.0) / math.sqrt(3.0) * beyond),
    }
    return floors[config.metric]


@lru_cache(maxsize=16)
def _second_derivative_variance(spacing: float, smoothness: float) -> float:
    """Return a quarter of the summed variances of d_uu and d_uv, of a smoothing spline fitted to unit noise.

    In an isotropic field these are three to one, so that this is the variance of d_uv. Far from borders the
    normal equations are a convolution, diagonal in frequency: with G the products of the basis functions and
    P the penalty, control values have the covariance G / (G + P)^2. The spacing of the knots is in grid
    pixels, and the mean over positions between them in one over grid pixels to the fourth power.
    """
    cosines = np.cos(np.outer(np.arange(4), 2.0 * np.pi * np.arange(64) / 64))
    # Integrals of products of cubic B-splines and of their first and second derivatives, 0 to 3 knots apart.
    values = spacing * (np.array([2416.0, 2382.0, 240.0, 2.0]) / 5040.0) @ cosines
    slopes = (np.array([80.0, -30.0, -48.0, -2.0]) / 120.0) @ cosines / spacing
    curvatures = (np.array([16.0, -18.0, 0.0, 2.0]) / 6.0) @ cosines / spacing**3
    penalty = (2.0 - 2.0 * cosines[1]) ** 2
    G = np.outer(values, values)
    covariance = G / (G + smoothness * (penalty[:, np.newaxis] + penalty)) ** 2
    derivatives = np.outer(slopes, slopes) + np.outer(curvatures, values)
    return float((covariance * derivatives).mean() / (4.0 * spacing**2))
