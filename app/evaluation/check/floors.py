"""Checks that the floors of the metrics follow from the sensor's noise at the measured points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.special import erfc

from nurbseg.app.evaluation.check.exported import ExportedFrame, Finding
from nurbseg.app.evaluation.check.values import have_points
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap

#: Factor of the noise at the border of a segment.
_RIM_FACTOR = 3.0
#: Relative error of noise, as inverse depths and distances are of single precision.
_SINGLE = 2.0**-21


def check_floors(frame: ExportedFrame, cloud: PointMap) -> Iterator[Finding]:
    """Recompute the floor of the deciding metric at the measured pixels of every segment.

    Noise of inverse depth moves a point along its ray by its deviation times depth times distance. Floors of
    curvature metrics do not depend on the points, so they are only compared with each other. Segments with
    damaged pixels are skipped; `cloud` holds the points of the same frame.
    """
    config = frame.settings.config
    floored = config.method == "nurbseg" and config.extended.noise_floor > 0
    per_point: dict[str, float] = {}
    for name, each in frame.segments.items():
        pixels = frame.measured.get(name, np.zeros(0, dtype=np.int64))
        if each.measured != frame.tree.frame or (each.surface and not have_points(pixels, cloud)):
            continue
        least = most = 0.0
        if floored and each.surface:
            if config.metric not in ("mse", "mae", "ve", "nle"):
                per_point[name] = each.floor / (each.points if config.metric == "nlc" else 1)
                continue
            noise_m = _noise(pixels, cloud, frame.step)
            noise_m *= config.extended.noise_floor * config.extended.inverse_depth_noise
            least, most = (_floor(noise_m * factor, config) for factor in (1.0 - _SINGLE, 1.0 + _SINGLE))
        if not least <= each.floor <= most:
            yield frame.wrong(name, "floor", f"{least:.9g} to {most:.9g}", each.floor)
    for name, floor in per_point.items():
        first = next(iter(per_point.values()))
        if not floor > 0 or abs(floor - first) > 1e-9 * first:
            yield frame.wrong(name, "floor", f"{first:.9g} as of others, more than 0", floor)


def _noise(pixels: NDArray[np.int64], cloud: PointMap, step: int) -> NDArray[np.float64]:
    """Return how far an error of 1/m in inverse depth moves each point, metres, including `_RIM_FACTOR`."""
    rows, columns = np.divmod(pixels, cloud.valid.shape[1])
    own = np.zeros(cloud.valid[::step, ::step].shape, dtype=np.bool_)
    own[rows // step, columns // step] = True
    inside = binary_erosion(own, np.ones((3, 3)))[rows // step, columns // step]
    points_m = cloud.points_m[rows, columns].astype(np.float64)
    moved = np.linalg.norm(points_m, axis=1) * points_m[:, 2]
    noise: NDArray[np.float64] = np.where(inside, moved, _RIM_FACTOR * moved)
    return noise


def _floor(noise_m: NDArray[np.float64], config: SegmentationConfig) -> float:
    """Return the expected metric of normal errors with these deviations."""
    if config.metric == "mae":
        return float(np.sqrt(2.0 / np.pi) * noise_m.mean())
    if config.metric == "nle":
        return float(erfc(config.large_error_m / (np.sqrt(2.0) * noise_m)).sum())
    return float(np.mean(noise_m**2)) * (1.0 if config.metric == "mse" else 1.0 - 2.0 / np.pi)
