"""Sensor noise: constant in inverse depth for a camera that triangulates; measured, and held against fits."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.inverse_depth import inverse_depth_image

#: A squared residual in units of the noise counts as no more than this, so that flying pixels do not decide.
SQUARE_MOST = 16.0
#: Mean of the squared residuals up to which a surface explains its points; pure noise gives 1.
_MEAN_MOST = 2.2
#: Residuals beyond this many standard deviations are far off, and the share of them that is allowed.
_FAR_DEVIATIONS = 3.0
_FAR_SHARE_MOST = 0.05
#: Half the side of the windows over which residuals are averaged, places, and the mean, in standard
#: deviations, beyond which a window holds something else than noise.
_PATCH_HALF, _PATCH_DEVIATIONS = 2, 2.5
#: Points at a segment's rim are often mixed with what lies behind: judged without it where this much is left.
_INNER_SHARE = 0.3


def explained_by_noise(
    residuals_per_m: NDArray[np.float64],
    mask: NDArray[np.bool_],
    noise_per_m: float,
    *,
    rim: bool = False,
    patch_places: float = np.inf,
) -> bool:
    """Say whether a surface leaves no more than noise.

    Parameters
    ----------
    residuals_per_m : (N,) float64
        Residuals of inverse depth at the marked places, in row order, 1/m.
    mask : (h, w) bool
        Places that the surface was fitted to.
    noise_per_m : float
        Standard deviation of the inverse depth, 1/m, more than 0.
    rim : bool
        Whether the places at the rim of the mask are judged too.
    patch_places : float
        A connected patch of so many places that lie to one side of the surface is a thing of its own,
        however small its share of a large segment; infinite for no such test.

    Returns
    -------
    bool
        Whether the mean of the squared residuals, in units of the noise and each limited, and the share
        of residuals that are far off are both what noise leaves, and no patch lies off the surface.
    """
    mask = np.ascontiguousarray(mask)
    everywhere, inside = _noise_counts(residuals_per_m, mask, 1.0 / noise_per_m)
    inner = not rim and inside[0] >= _INNER_SHARE * everywhere[0]
    count, far, squares = inside if inner else everywhere
    if not (squares < _MEAN_MOST * count and far < _FAR_SHARE_MOST * count):
        return False
    # Far residuals are fewer than the patch: the usual case, and the cheap one.
    if far < patch_places:
        return True
    return not _has_patch(residuals_per_m / noise_per_m, mask, inner, patch_places)


@compiled
def _noise_counts(
    residuals_per_m: NDArray[np.float64], mask: NDArray[np.bool_], per_noise: float
) -> tuple[tuple[int, int, float], tuple[int, int, float]]:
    """Count all places of a mask and those not at its rim: how many, how many far off, limited squares."""
    height, width = mask.shape
    three, inner = np.zeros(width, dtype=np.bool_), np.zeros(width, dtype=np.bool_)
    n, far, squares = 0, 0, 0.0
    inner_n, inner_far, inner_squares = 0, 0, 0.0
    for y in range(height):
        if 0 < y < height - 1:
            for x in range(width):
                three[x] = mask[y - 1, x] & mask[y, x] & mask[y + 1, x]
            for x in range(1, width - 1):
                inner[x] = three[x - 1] & three[x] & three[x + 1]
        else:
            inner[:] = False
        for x in range(width):
            if mask[y, x]:
                deviation = residuals_per_m[n] * per_noise
                square = deviation * deviation
                is_far = square > _FAR_DEVIATIONS * _FAR_DEVIATIONS
                square = min(square, SQUARE_MOST)
                n += 1
                far += is_far
                squares += square
                inner_n += inner[x]
                inner_far += is_far & inner[x]
                inner_squares += square if inner[x] else 0.0
    return (n, far, squares), (inner_n, inner_far, inner_squares)


def _has_patch(
    deviations: NDArray[np.float64], mask: NDArray[np.bool_], inner: bool, patch_places: float
) -> bool:
    """Say whether a connected patch of places lies off the surface, noise being averaged out."""
    image, judged = np.zeros(mask.shape, dtype=np.float32), mask
    # Limited, so that one flying pixel does not make a patch of its window.
    image[mask] = np.clip(deviations, -SQUARE_MOST, SQUARE_MOST)
    if inner:
        kernel = np.ones((3, 3), dtype=np.uint8)
        eroded = cv2.erode(mask.view(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        judged = eroded.view(np.bool_)
        image[~judged] = 0.0
    size = (2 * _PATCH_HALF + 1, 2 * _PATCH_HALF + 1)
    weight = cv2.boxFilter(judged.astype(np.float32), -1, size, borderType=cv2.BORDER_CONSTANT)
    mean = cv2.boxFilter(image, -1, size, borderType=cv2.BORDER_CONSTANT) / np.maximum(weight, 1e-6)
    for off in (mean > _PATCH_DEVIATIONS, mean < -_PATCH_DEVIATIONS):
        patches = cv2.connectedComponentsWithStats((off & judged).astype(np.uint8), connectivity=4)[2]
        if patches[1:, cv2.CC_STAT_AREA].max(initial=0) >= patch_places:
            return True
    return False


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """The noise of a depth sensor, from the largest planes of some frames.

    Parameters
    ----------
    noise_per_m : float
        Root mean square residual of inverse depth on the planes, 1/m: what the setting of that name takes.
    nearest_per_m, farthest_per_m : float
        The same for the nearest and the farthest third of the points. Where they differ much, the noise
        is not constant in inverse depth.
    nearest_m, farthest_m : float
        Mean depths of these thirds, metres.
    points : int
        Points on the planes.
    frames : int
        Frames that had a plane.
    """

    noise_per_m: float
    nearest_per_m: float
    farthest_per_m: float
    nearest_m: float
    farthest_m: float
    points: int
    frames: int


#: Points of a frame that are looked at, and planes through three of them that are tried.
_POINTS = 4_000
_TRIALS = 300
#: Half width of the slab in which the largest plane is counted, 1/m, and the share of points it must hold.
_SLAB_PER_M = 0.02
_PLANE_SHARE = 0.1
#: Residuals kept in each of the refits, in units of their own median deviation (a normal one's sigma).
_KEPT_DEVIATIONS = 4.0
_REFITS = 10


def measure_noise(clouds: Iterable[PointMap], *, seed: int = 0) -> NoiseEstimate:
    """Measure a sensor's noise on the largest plane of each frame: a table, a floor or a flat wall.

    A plane is linear in inverse depth. The largest is found by random sampling, then fitted by trimmed
    least squares; what it leaves is the noise, and whatever the plane itself is not flat by.

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
    residual, per_m = np.concatenate(residuals), np.concatenate(inverse_depths)
    lower, upper = np.quantile(per_m, (1 / 3, 2 / 3))
    near, far = per_m >= upper, per_m <= lower

    def size(values: NDArray[np.float64]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    return NoiseEstimate(
        noise_per_m=size(residual),
        nearest_per_m=size(residual[near]),
        farthest_per_m=size(residual[far]),
        nearest_m=float(1.0 / per_m[near].mean()),
        farthest_m=float(1.0 / per_m[far].mean()),
        points=residual.size,
        frames=frames,
    )


def _largest_plane(
    cloud: PointMap, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return residuals and inverse depths of the points of a frame's largest plane."""
    per_m = inverse_depth_image(cloud)
    rows, columns = np.nonzero(per_m > 0)
    if rows.size < 3:
        return None
    d = per_m[rows, columns].astype(np.float64)
    terms = np.stack([np.ones(d.size), columns / per_m.shape[1], rows / per_m.shape[0]], axis=1)
    sample = rng.choice(d.size, size=min(_POINTS, d.size), replace=False)
    best, plane = 0, np.zeros(3)
    for corners in rng.integers(0, sample.size, (_TRIALS, 3)):
        A = terms[sample[corners]]
        if abs(np.linalg.det(A)) < 1e-6:
            continue
        candidate = np.linalg.solve(A, d[sample[corners]])
        held = int(np.count_nonzero(np.abs(terms[sample] @ candidate - d[sample]) < _SLAB_PER_M))
        if held > best:
            best, plane = held, candidate
    if best < max(3, _PLANE_SHARE * sample.size):
        return None
    limit = _SLAB_PER_M
    for _ in range(_REFITS):
        kept = np.abs(terms @ plane - d) < limit
        plane = np.linalg.lstsq(terms[kept], d[kept], rcond=None)[0]
        deviation = 1.4826 * float(np.median(np.abs(terms[kept] @ plane - d[kept])))
        limit = min(_SLAB_PER_M, _KEPT_DEVIATIONS * deviation)
        if limit == 0.0:
            break
    kept = np.abs(terms @ plane - d) <= max(limit, 1e-12)
    if np.count_nonzero(kept) < max(3, _PLANE_SHARE * d.size):
        return None
    return (terms @ plane - d)[kept], d[kept]


__all__ = ["SQUARE_MOST", "NoiseEstimate", "explained_by_noise", "measure_noise"]
