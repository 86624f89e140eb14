"""The effect of sensor noise, constant in inverse depth for triangulating cameras, on metrics."""

import math
from functools import lru_cache

import numpy as np

from nurbseg.common.compiled import F32, F64, I32, inlined_once
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.points.grid import DepthGrid

#: Factor on the noise at a segment's rim, where points are often mixed with the background.
_RIM_FACTOR = 3.0


def knots_on(grid: DepthGrid, config: SegmentationConfig) -> tuple[float, float]:
    """Return the knot spacing, grid pixels, and the weight of second differences on the grid."""
    return (
        config.extended.knot_spacing_px * grid.unit_px / grid.step,
        config.extended.smoothness * (2.0 * grid.unit_px / grid.step) ** 2,
    )


def floor_weights(config: SegmentationConfig) -> tuple[float, float, float]:
    """Return the weights of sums over points in the floor of the deciding metric.

    The floor is the value that noise alone explains, the least that the metric counts for in eq. 5. Noise of
    inverse depth with deviation s moves a point at depth z and distance |p| by s z |p| along its ray, at the
    rim of a segment by three times as much, as points there are often mixed with the background. Residual
    metrics are those expected of normal noise of that size at the segment's points; curvature metrics are
    those of a surface fitted to a noisy plane that faces the camera (`curvature_floor`).

    The floor times the number of points (for counts, the floor) is a sum over points. No point contributes
    less in a part than in the whole, since rim points remain at the rim. So the ratio of any split is at
    least the floor of the whole over its value.

    Parameters
    ----------
    config : SegmentationConfig
        The metric.

    Returns
    -------
    mean, mean_square, large : float
        Weights of the mean deviation of points, of the mean of its square, and of the number of points that
        noise moves by more than T_l, the sum of their probabilities.
    """
    weights: dict[Metric, tuple[float, float, float]] = {
        "mse": (0.0, 1.0, 0.0),
        # The absolute value of a normal variable: its mean, and its variance, in units of the deviation.
        "mae": (math.sqrt(2.0 / math.pi), 0.0, 0.0),
        "ve": (0.0, 1.0 - 2.0 / math.pi, 0.0),
        "nle": (0.0, 0.0, 1.0),
    }
    return weights.get(config.metric, (0.0, 0.0, 0.0))


@inlined_once
def noise_floor(
    runs: I32,
    images: tuple[F32, F32],
    deviation_and_limit: tuple[float, float],
    weights: tuple[float, float, float],
    rim: F64,
) -> float:
    """Return the floor of a metric of residuals times the number of points.

    The points are those of runs: row, first column and one past the last. Given are also their inverse depths
    and distances, the deviation of inverse depth and T_l, `floor_weights`, and memory for a row, `rim`.
    """
    (inverse_depth, distances_m), limit_m = images, deviation_and_limit[1]
    stop, row = runs.shape[0], -1
    line = above = above_end = below = 0
    total = squares = large = 0.0
    size = 0
    scale = np.float64(deviation_and_limit[0])
    for k in range(stop):
        if runs[k, 0] != row:
            # The runs of the rows above and below begin at `above` and `below`; `line` is that of this row.
            above, above_end = (line if runs[k, 0] == row + 1 else k), k
            row, line = runs[k, 0], k
            while below < stop and runs[below, 0] <= row:
                below += 1
        begin, end = runs[k, 1], runs[k, 2]
        size += end - begin
        rim[begin:end] = _RIM_FACTOR
        while above < above_end and below < stop and runs[below, 0] == row + 1:
            inner = max(begin, max(runs[above, 1], runs[below, 1])) + 1
            for x in range(inner, min(end, min(runs[above, 2], runs[below, 2])) - 1):
                rim[x] = 1.0
            if min(runs[above, 2], runs[below, 2]) >= end:
                break
            if runs[above, 2] <= runs[below, 2]:
                above += 1
            else:
                below += 1
        for x in range(np.uint32(begin), np.uint32(end)):
            noise_m = scale * distances_m[row, x] / inverse_depth[row, x] * rim[x]
            total += noise_m
            squares += noise_m * noise_m
        if weights[2] > 0.0:
            for x in range(begin, end):
                noise_m = scale * distances_m[row, x] / inverse_depth[row, x] * rim[x]
                large += math.erfc(limit_m / (math.sqrt(2.0) * noise_m))
    return weights[0] * total + weights[1] * squares + weights[2] * large * size


def curvature_floor(points: int, grid: DepthGrid, config: SegmentationConfig) -> float:
    """Return the floor of a curvature metric, from a plane that faces the camera.

    Its curvature is, but for the sign, f^2 times the second derivatives of inverse depth, at any depth. For
    an isotropic normal field these are three independent normal variables: the mean curvature H of variance
    2 t, and two of variance t, whose length R is half the difference of the principal curvatures. So the
    largest absolute curvature is |H| + R, and the Gaussian curvature H^2 - R^2.
    """
    fx, fy = grid.rays.focal_px
    scale = config.extended.noise_floor * config.extended.inverse_depth_noise * fx * fy / grid.step**2
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
