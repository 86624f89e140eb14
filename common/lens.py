"""OpenCV's model of lens distortion."""

import cv2
import numpy as np
from numpy.typing import NDArray

_ITERATIONS = 50


def undistort(
    points: NDArray[np.float64], distortion: NDArray[np.float64], tolerance: float
) -> NDArray[np.float64]:
    """Return the undistorted image coordinates, x / z and y / z, of distorted ones.

    Parameters
    ----------
    points : (N, 2) float64
        As seen through the lens.
    distortion : (K,) float64
        OpenCV's coefficients (k1, k2, p1, p2, k3, ...), dimensionless.
    tolerance : float
        Largest error of a point that is distorted again, in the unit of the coordinates.

    Returns
    -------
    (N, 2) float64
        NaN where none is found within the tolerance, as in the far corners of a model that folds over.
    """
    none, identity = np.zeros(3), np.eye(3)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ITERATIONS, tolerance / 10)
    found = cv2.undistortImagePoints(points[:, None], identity, distortion, arg1=criteria).reshape(-1, 2)
    rays = np.column_stack([found, np.ones(len(found))])
    again = cv2.projectPoints(rays, none, none, identity, distortion)[0].reshape(-1, 2)
    _, fold_radius, _ = lens_terms(distortion)
    with np.errstate(invalid="ignore"):
        is_close = np.abs(again - points).max(axis=1) < tolerance
        found[~(is_close & (np.hypot(*found.T) <= fold_radius))] = np.nan
    return np.asarray(found, dtype=np.float64)


def lens_terms(
    distortion: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """Return what a projection through the lens computes with.

    Parameters
    ----------
    distortion : (K,) float64
        OpenCV's coefficients; may be empty.

    Returns
    -------
    coefficients : (14,) float64
        The same, 0 where there is none.
    fold_radius : float
        Distance from the axis up to which the radial distortion grows with it; inf if it always does. The
        model would bring points beyond back into the image.
    tilt : (3, 3) float64
        The homography of a sensor that is tilted behind its lens.

    References
    ----------
    .. [1] OpenCV, "Camera Calibration and 3D Reconstruction", the detailed description of the model.
    """
    k = np.zeros(14)
    k[: distortion.size] = distortion
    r = np.linspace(0.0, 10.0, 10_001)
    r2 = r * r
    with np.errstate(divide="ignore", invalid="ignore"):
        radial = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))
        distorted = r * radial / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
    folds = np.flatnonzero(~(np.diff(distorted) > 0))
    return k, float(r[folds[0]]) if folds.size else np.inf, _tilt(k[12], k[13])


def _tilt(tau_x: float, tau_y: float) -> NDArray[np.float64]:
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    rotation = about_y @ about_x
    r13, r23, r33 = rotation[:, 2]
    return np.asarray(np.array([[r33, 0, -r13], [0, r33, -r23], [0, 0, 1]]) @ rotation)
