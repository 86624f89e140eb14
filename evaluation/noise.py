"""The noise of a depth sensor, measured on the largest planes of some frames."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import OUTLIER_DEVIATIONS
from nurbseg.segmentation.points.grid import inverse_depth_image
from nurbseg.segmentation.points.registration import PointMap

#: Points of a frame that are used, and planes through three of them that are tried.
_POINTS = 4_000
_TRIALS = 300
#: Largest residual of an inlier of the largest plane, 1/m, and the least share of inliers.
_INLIER_PER_M = 0.02
_PLANE_SHARE = 0.1
_REFITS = 10


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """The noise of a depth sensor, from the largest planes of some frames.

    Parameters
    ----------
    inverse_depth_noise : float
        Root mean square residual of inverse depth on the planes, 1/m: a value for the setting of that name.
    nearest_per_m, farthest_per_m : float
        The same for the nearest and the farthest third of the points; very different values mean that the
        noise is not constant in inverse depth.
    nearest_m, farthest_m : float
        Mean depths of these thirds, meters.
    points : int
        Points on the planes.
    frames : int
        Frames that had a plane.
    """

    inverse_depth_noise: float
    nearest_per_m: float
    farthest_per_m: float
    nearest_m: float
    farthest_m: float
    points: int
    frames: int


def measure_noise(clouds: Iterable[PointMap], *, seed: int = 0) -> NoiseEstimate:
    """Measure a sensor's noise on the largest plane of each frame: a table, a floor or a flat wall.

    A plane is linear in inverse depth. The largest is found by random sampling, then fitted by trimmed least
    squares; its residuals are the noise, and any unevenness of the real surface.

    Parameters
    ----------
    clouds : iterable of PointMap
        Frames of one sensor.
    seed : int
        Of the random sampling.

    Returns
    -------
    NoiseEstimate
        Over all frames that have a plane.

    Raises
    ------
    ValueError
        If no frame has a plane that holds a tenth of its points.

    References
    ----------
    .. [1] K. Khoshelham and S. O. Elberink, "Accuracy and resolution of Kinect depth data for indoor
       mapping applications", Sensors 12(2), 2012.
    """
    residuals, inverse_depths, frames = [], [], 0
    for cloud in clouds:
        found = _largest_plane(cloud, np.random.default_rng([seed, frames]))
        if found is not None:
            residuals.append(found[0])
            inverse_depths.append(found[1])
            frames += 1
    if not frames:
        raise ValueError("clouds: expected a frame with a plane that holds a tenth of its points, got none")
    residual, inverse_depth = np.concatenate(residuals), np.concatenate(inverse_depths)
    lower, upper = np.quantile(inverse_depth, (1 / 3, 2 / 3))
    near, far = inverse_depth >= upper, inverse_depth <= lower

    def size(values: NDArray[np.float64]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    return NoiseEstimate(
        inverse_depth_noise=size(residual),
        nearest_per_m=size(residual[near]),
        farthest_per_m=size(residual[far]),
        nearest_m=float(1.0 / inverse_depth[near].mean()),
        farthest_m=float(1.0 / inverse_depth[far].mean()),
        points=residual.size,
        frames=frames,
    )


def _largest_plane(
    cloud: PointMap, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return residuals and inverse depths of the points of a frame's largest plane."""
    inverse_depth = inverse_depth_image(cloud)
    rows, columns = np.nonzero(inverse_depth > 0)
    if rows.size < 3:
        return None
    d = inverse_depth[rows, columns].astype(np.float64)
    terms = np.stack(
        [np.ones(d.size), columns / inverse_depth.shape[1], rows / inverse_depth.shape[0]], axis=1
    )
    sample = rng.choice(d.size, size=min(_POINTS, d.size), replace=False)
    corners = sample[rng.integers(0, sample.size, (_TRIALS, 3))]
    corners = corners[np.abs(np.linalg.det(terms[corners])) >= 1e-6]
    planes = np.linalg.solve(terms[corners], d[corners, np.newaxis])[..., 0]
    held = np.count_nonzero(np.abs(planes @ terms[sample].T - d[sample]) < _INLIER_PER_M, axis=1)
    if held.max(initial=0) < max(3, _PLANE_SHARE * sample.size):
        return None
    plane = planes[held.argmax()]
    limit = _INLIER_PER_M
    for _ in range(_REFITS):
        kept = np.abs(terms @ plane - d) < limit
        plane = np.linalg.lstsq(terms[kept], d[kept], rcond=None)[0]
        deviation = 1.4826 * float(np.median(np.abs(terms[kept] @ plane - d[kept])))
        limit = min(_INLIER_PER_M, OUTLIER_DEVIATIONS * deviation)
        if limit == 0.0:
            break
    kept = np.abs(terms @ plane - d) <= max(limit, 1e-12)
    if np.count_nonzero(kept) < max(3, _PLANE_SHARE * d.size):
        return None
    return (terms @ plane - d)[kept], d[kept]
