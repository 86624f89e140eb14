"""Checks that values and floors follow from the surfaces and the recording's points."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion
from scipy.special import erfc

from nurbseg.evaluation.check.exported import ExportedFrame
from nurbseg.evaluation.check.surfaces import SURFACES, derivatives, malformed
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS

#: Residuals of at most this size come from rounding of the points and count as 0.
_ROUNDING_M = 1e-6
#: Relative error of inverse depths and distances, which are of single precision.
_SINGLE = 2.0**-22
#: Relative error of values computed in double precision, including curvature.
_DOUBLE = 1e-9
#: Tangents whose parallelogram is smaller than this share of their squares do not span a plane.
_FLAT_SHARE = 1e-9
#: Maximum angle between a surface point and its pixel's ray, radians: half a pixel at 640 columns.
_BESIDE_MOST = 1e-3
#: Factor of the noise at the border of a segment.
_RIM_FACTOR = 3.0
#: Relative error of noise, as inverse depths and distances are of single precision.
_NOISE_ERROR = 2.0**-21
#: Smallest and largest valid value.
Bounds = tuple[float, float]


def check_values(frame: ExportedFrame, cloud: PointMap) -> None:
    """Recompute the values of every segment from its surface and the points at its measured pixels.

    Damaged surfaces are skipped; `cloud` holds the points of the same frame.
    """
    labeled, config = frame.leaf_image > 0, frame.settings.config
    if labeled.shape != cloud.valid.shape:
        frame.wrong("", "height, width", f"{cloud.valid.shape} as recorded", labeled.shape)
        return
    if not np.array_equal(labeled, cloud.valid):
        row, column = np.argwhere(labeled != cloud.valid)[0].tolist()
        expected = "a label" if cloud.valid[row, column] else "no label, there is no point"
        found = f"{frame.leaf_image[row, column]} there"
        frame.wrong("", f"pixel [{row}, {column}]", expected, found, "labels.png")
        return
    for name, surface in frame.surfaces.items():
        if malformed(surface) or name not in frame.segments:
            continue
        pixels = frame.measured.get(name, np.zeros(0, dtype=np.int64))
        if not have_points(pixels, cloud):
            frame.wrong(name, "measured", "pixels that have a point", "others", SURFACES)
            continue
        rows, columns = np.divmod(pixels, frame.shape[1])
        points_m = cloud.points_m[rows, columns].astype(np.float64)
        values = frame.segments[name].values
        S = derivatives(surface, rows, columns, order=2 if "vgc" in values else 0)
        if config.method == "nurbseg":
            residuals_m, off_m, beside = _along_rays(S[0, 0], points_m)
            if beside > _BESIDE_MOST:
                expected = f"surface points on their rays, to {_BESIDE_MOST} rad"
                frame.wrong(name, "control_points_m", expected, f"{beside:.2g} rad", SURFACES)
        else:
            residuals_m = np.linalg.norm(S[0, 0] - points_m, axis=1)
            off_m = _DOUBLE * np.linalg.norm(points_m, axis=1)
        bounds = residual_bounds(residuals_m, off_m, config)
        if "vgc" in values:
            bounds |= {
                key: (value * (1.0 - _DOUBLE), value * (1.0 + _DOUBLE))
                for key, value in curvature_values(S, config).items()
            }
        if set(values) != set(bounds):
            frame.wrong(name, "values", sorted(bounds), sorted(values))
        for key in values.keys() & bounds.keys():
            (least, most), value = bounds[key], values[key]
            if value is None or not least <= value <= most:
                frame.wrong(name, key, f"{least:.9g} to {most:.9g}", value)


def have_points(pixels: NDArray[np.int64], cloud: PointMap) -> bool:
    """Whether there are pixels, and all of them are in the image and have a point."""
    inside = pixels[(pixels >= 0) & (pixels < cloud.valid.size)]
    return 0 < inside.size == pixels.size and bool(cloud.valid.ravel()[inside].all())


def _along_rays(
    on_surface_m: NDArray[np.float64], points_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return distances of points to a surface along their rays, their errors, and the largest angle.

    A surface of inverse depth meets each pixel's ray in one point, whose distance is proportional to its
    depth. The angle is that between the rays of a point and of its surface point, radians.
    """
    distances_m = np.linalg.norm(points_m, axis=1)
    residuals_m = distances_m * np.abs(on_surface_m[:, 2] / points_m[:, 2] - 1.0)
    rays = (each[:, :2] / each[:, 2:] for each in (on_surface_m, points_m))
    beside = np.abs(np.subtract(*rays)).max(initial=0.0)
    return residuals_m, _SINGLE * (distances_m + residuals_m), float(beside)


def residual_bounds(
    residuals_m: NDArray[np.float64], off_m: NDArray[np.float64], config: SegmentationConfig
) -> dict[str, Bounds]:
    """Recompute the metrics of residuals (eq. 7, 9, 11 and section 4.4).

    Parameters
    ----------
    residuals_m : (N,) float64
        Distance of each point to its surface point, meters.
    off_m : (N,) float64
        By how much each may be off, meters.
    config : SegmentationConfig
        Its `large_error_m` is T_l.

    Returns
    -------
    dict of str to (float, float)
        Bounds of ``mse``, ``mae``, ``ve`` and ``nle``.
    """
    low, high = np.maximum(residuals_m - off_m, 0.0), residuals_m + off_m
    # A standard deviation changes by no more than the root mean square of what is added.
    deviation, added = float(residuals_m.std()), float(np.sqrt(np.mean(off_m**2)))
    fewest, most = (float(np.count_nonzero(each > config.large_error_m)) for each in (low, high))
    bounds: dict[str, Bounds] = {
        "mse": (float(np.mean(low**2)), float(np.mean(high**2))),
        "mae": (float(low.mean()), float(high.mean())),
        "ve": (max(deviation - added, 0.0) ** 2, (deviation + added) ** 2),
        "nle": (fewest, most),
    }
    if low.max() <= _ROUNDING_M:
        bounds = {key: (0.0, largest) for key, (_, largest) in bounds.items()}
    return bounds


def curvature_values(
    S: Mapping[tuple[int, int], NDArray[np.float64]], config: SegmentationConfig
) -> dict[str, float]:
    """Recompute the metrics of curvature (eq. 14 to 19 and section 4.9) by the two fundamental forms.

    Parameters
    ----------
    S : mapping of (int, int) to (N, 3) float64
        Derivatives up to the second order at the measured pixels.
    config : SegmentationConfig
        Its `large_curvature_per_m` is T_c.

    Returns
    -------
    dict of str to float
        ``vmxc``, ``vmec``, ``vgc``, ``mmxc`` and ``nlc``.

    References
    ----------
    .. [1] M. do Carmo, "Differential Geometry of Curves and Surfaces", 1976, section 3-3.
    """
    normal = np.cross(S[1, 0], S[0, 1])
    area = np.linalg.norm(normal, axis=1)
    E, F, G = (np.sum(S[a] * S[b], axis=1) for a, b in (((1, 0), (1, 0)), ((1, 0), (0, 1)), ((0, 1), (0, 1))))
    plane = area > _FLAT_SHARE * (E + G)
    if not plane.any():
        return {metric: 0.0 for metric in CURVATURE_METRICS}
    L, M, N = (np.sum(S[at] * normal, axis=1)[plane] / area[plane] for at in ((2, 0), (1, 1), (0, 2)))
    E, F, G = E[plane], F[plane], G[plane]
    gaussian = (L * N - M**2) / area[plane] ** 2
    mean = (E * N - 2.0 * F * M + G * L) / (2.0 * area[plane] ** 2)
    largest = np.abs(mean) + np.sqrt(np.maximum(mean**2 - gaussian, 0.0))
    return {
        "vmxc": float(np.var(largest)),
        "vmec": float(np.var(mean)),
        "vgc": float(np.var(gaussian)),
        "mmxc": float(np.mean(largest)),
        "nlc": float(np.count_nonzero(largest > config.large_curvature_per_m)),
    }


def check_floors(frame: ExportedFrame, cloud: PointMap) -> None:
    """Recompute the floor of the deciding metric at the measured pixels of every segment.

    Noise of inverse depth moves a point along its ray by its deviation times depth times distance. Floors of
    curvature metrics do not depend on the points, so they are only compared with each other. Segments with
    damaged pixels are skipped; `cloud` holds the points of the same frame.
    """
    config = frame.settings.config
    floored = config.method == "nurbseg" and config.extended.noise_floor > 0
    per_point: dict[str, float] = {}
    for name, segment in frame.segments.items():
        pixels = frame.measured.get(name, np.zeros(0, dtype=np.int64))
        if segment.measured != frame.tree.frame or (segment.surface and not have_points(pixels, cloud)):
            continue
        least = most = 0.0
        if floored and segment.surface:
            if config.metric in CURVATURE_METRICS:
                per_point[name] = segment.floor / (segment.points if config.metric == "nlc" else 1)
                continue
            noise_m = _noise(pixels, cloud, frame.step)
            noise_m *= config.extended.noise_floor * config.extended.inverse_depth_noise
            least, most = (
                _floor(noise_m * factor, config) for factor in (1.0 - _NOISE_ERROR, 1.0 + _NOISE_ERROR)
            )
        if not least <= segment.floor <= most:
            frame.wrong(name, "floor", f"{least:.9g} to {most:.9g}", segment.floor)
    for name, floor in per_point.items():
        first = next(iter(per_point.values()))
        # The probability of a curvature beyond T_c may be too small for a number.
        positive = floor > 0 or (floor == 0 and config.metric == "nlc")
        if not positive or abs(floor - first) > 1e-9 * first:
            frame.wrong(name, "floor", f"{first:.9g} as of others, more than 0", floor)


def _noise(pixels: NDArray[np.int64], cloud: PointMap, step: int) -> NDArray[np.float64]:
    """Return how far an error of 1/m in inverse depth moves each point, meters, including `_RIM_FACTOR`."""
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
    if config.metric == "nle":
        return float(erfc(config.large_error_m / (np.sqrt(2.0) * noise_m)).sum())
    mean_square = float(np.mean(noise_m**2))
    floors: dict[Metric, float] = {
        "mse": mean_square,
        "mae": float(np.sqrt(2.0 / np.pi) * noise_m.mean()),
        "ve": mean_square * (1.0 - 2.0 / np.pi),
    }
    return floors[config.metric]
