"""Checks that trials of creases follow from the recording's points, by planes and splines of its own."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from nurbseg.evaluation.check.exported import ExportedFrame, ExportedSegment, ExportedTrial
from nurbseg.evaluation.check.values import have_points, residual_bounds
from nurbseg.segmentation.points.registration import PointMap

#: Deviations of the noise up to which a plane explains a point, and beyond which residuals count no more;
#: how often it is fitted again; and least angle between planes that meet in a crease, degrees.
_EXPLAINED, _LIMIT, _REFITS, _ANGLE_LEAST = 3.0, 4.0, 4, 20.0
#: Ridge of a plane fit, as a share of the variances of rays about the first.
_RIDGE_SHARE = 1e-6
#: How far splines extend beyond points, pixels of a 640-wide image.
_MARGIN_PX = 24.0
#: Relative error of values at creases: a point may be just within a limit, or just beyond it.
_CREASE_ERROR = 1e-3


def check_creases(frame: ExportedFrame, cloud: PointMap) -> None:
    """Recompute the trials of creases that were found in this frame, from the points of their parts.

    `cloud` holds the points of the same frame. Parts whose measured pixels are damaged are skipped.
    """
    for name, segment in frame.segments.items():
        if segment.division != "crease" or segment.trial is None or segment.judged != frame.tree.frame:
            continue
        parts = [frame.measured.get(part.name, np.zeros(0, dtype=np.int64)) for part in frame.parts(name)]
        if all(have_points(pixels, cloud) for pixels in parts):
            _check_crease(frame, segment, segment.trial, parts, cloud)


def _check_crease(
    frame: ExportedFrame,
    each: ExportedSegment,
    trial: ExportedTrial,
    parts: list[NDArray[np.int64]],
    cloud: PointMap,
) -> None:
    planes, folds_per_m, explained = [], [], []
    for pixels in parts:
        points_m = cloud.points_m.reshape(-1, 3)[pixels].astype(np.float64)
        rays = points_m / points_m[:, 2:]
        planes.append(_plane(rays, 1.0 / points_m[:, 2], frame.settings.config.extended.inverse_depth_noise))
        folds_per_m.append(rays @ planes[-1])
        off = np.abs(folds_per_m[-1] - 1.0 / points_m[:, 2])
        explained.append(off < _EXPLAINED * frame.settings.config.extended.inverse_depth_noise)
    normals = np.array([plane / np.linalg.norm(plane) for plane in planes])
    angle = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0).min())))
    if angle < _ANGLE_LEAST * (1.0 - _CREASE_ERROR):
        frame.wrong(each.name, "division", f"planes that meet at {_ANGLE_LEAST:g} degrees", f"{angle:.3g}")
    pixels = np.concatenate([own[kept] for own, kept in zip(parts, explained, strict=True)])
    folds = np.concatenate([own[kept] for own, kept in zip(folds_per_m, explained, strict=True)])
    if not all(kept.any() for kept in explained):
        frame.wrong(each.name, "division", "parts that planes explain", "one that is not")
        return
    smooth_m = _residuals(pixels, np.zeros_like(folds), cloud, frame)
    folded_m = _residuals(pixels, folds, cloud, frame)
    ends = np.cumsum([np.count_nonzero(kept) for kept in explained])[:-1]
    metric = frame.settings.config.metric
    first, *others = (
        (residual_bounds(own, np.zeros_like(own), frame.settings.config).get(metric, (0.0, 0.0))[1], own.size)
        for own in (smooth_m, *np.split(folded_m, ends))
    )
    expected = [first, *sorted(others)]
    whole, *below = [(value or 0.0, points) for value, points in (trial.whole, *trial.parts)]
    exported = [whole, *sorted(below)]
    if len(expected) != len(exported) or not np.allclose(expected, exported, rtol=_CREASE_ERROR, atol=0.0):
        frame.wrong(each.name, "trial", f"values and points {expected}", exported)


def _plane(
    rays: NDArray[np.float64], inverse_depth: NDArray[np.float64], noise_per_m: float
) -> NDArray[np.float64]:
    """Fit a plane to points by ridge regression, and again to those near it."""
    near, plane = np.ones(inverse_depth.size, dtype=np.bool_), np.zeros(3)
    for _ in range(1 + _REFITS):
        own, level = rays[near, :2], inverse_depth[near].mean()
        # Points on a line do not tell the slope across it.
        ridge = np.sqrt(_RIDGE_SHARE * np.sum((own - rays[0, :2]) ** 2) + 1e-12) * np.eye(2)
        A, b = np.vstack([own - own.mean(axis=0), ridge]), np.append(inverse_depth[near] - level, [0.0, 0.0])
        plane[:2] = np.linalg.lstsq(A, b, rcond=None)[0]
        plane[2] = level - own.mean(axis=0) @ plane[:2]
        off = np.abs(rays @ plane - inverse_depth)
        rms_per_m = np.sqrt(np.mean(np.minimum(off, _LIMIT * noise_per_m) ** 2))
        near = off < max(_EXPLAINED * noise_per_m, 2.0 * rms_per_m)
    return plane


def _residuals(
    pixels: NDArray[np.int64], folds_per_m: NDArray[np.float64], cloud: PointMap, frame: ExportedFrame
) -> NDArray[np.float64]:
    """Return the distances of points to the smoothing spline that is fitted to what folds leave, meters."""
    extended, step, unit = frame.settings.config.extended, frame.step, frame.shape[1] / 640.0
    points_m = cloud.points_m.reshape(-1, 3)[pixels].astype(np.float64)
    inverse_depth = 1.0 / points_m[:, 2]
    spacing, margin = extended.knot_spacing_px * unit / step, np.ceil(_MARGIN_PX * unit / step)
    bases, penalties = [], []
    for at in (pixels // frame.shape[1] // step, pixels % frame.shape[1] // step):
        first = (at.min() - margin) // spacing - 3
        last = (at.max() + margin) // spacing + 4
        knots = spacing * np.arange(first, last + 1)
        bases.append(BSpline.design_matrix(at.astype(np.float64), knots, 3).toarray())
        differences = np.diff(np.eye(bases[-1].shape[1]), 2, axis=0)
        penalties.append(differences.T @ differences)
    A = np.einsum("na,nb->nab", *bases).reshape(pixels.size, -1)
    rows, columns = (np.eye(len(penalty)) for penalty in penalties)
    smoothness = extended.smoothness * (2.0 * unit / step) ** 2
    penalty = smoothness * (np.kron(penalties[0], columns) + np.kron(rows, penalties[1]))
    wanted = inverse_depth - folds_per_m
    control = np.linalg.lstsq(A.T @ A + penalty, A.T @ wanted, rcond=None)[0]
    off_per_m = A @ control - wanted
    residuals_m: NDArray[np.float64] = np.abs(off_per_m / inverse_depth) * np.linalg.norm(points_m, axis=1)
    return residuals_m
