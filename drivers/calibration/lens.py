"""How a lens bends what a pinhole would draw straight."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Image = TypeVar("Image", NDArray[np.float32], NDArray[np.float64])


class Lens:
    """OpenCV's distortion model, over whole images and in their precision.

    Parameters
    ----------
    distortion : (K,) float64
        OpenCV's coefficients (k1, k2, p1, p2, k3, ...), dimensionless; may be empty.

    References
    ----------
    .. [1] OpenCV, "Camera Calibration and 3D Reconstruction", the detailed description of the model.
    """

    def __init__(self, distortion: NDArray[np.float64]) -> None:
        k = np.zeros(14)
        k[: distortion.size] = distortion
        # Python's numbers take on the precision of the image that they meet.
        self._k: list[float] = k.tolist()
        self._fold = _fold_radius(k)
        self._tilt: Any = _tilt(k[12], k[13]).tolist() if k[12:].any() else None

    @property
    def model(self) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
        """The 14 coefficients, the radius at which the model folds over, and the tilt's (3, 3) homography."""
        return np.array(self._k), self._fold, np.eye(3) if self._tilt is None else np.array(self._tilt)

    def bend(self, x: Image, y: Image) -> tuple[Image, Image]:
        """Return where straight image coordinates, x / z and y / z, fall behind the lens.

        They are to be limited: a ray at a right angle to the axis has no place.
        """
        if not any(self._k):
            return x, y
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self._k[:12]
        r2 = x * x + y * y
        radial = r2 * k3
        radial += k2
        radial *= r2
        radial += k1
        radial *= r2
        radial += 1
        if k4 or k5 or k6:
            radial /= 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        # Beyond the fold the model would bring points back into the image: they are sent far outside.
        radial[r2 > self._fold**2] = 10
        # The tangential terms, 2 p1 x y + p2 (r2 + 2 x^2) and its like, share a factor with the radial.
        radial += y * (2 * p1)
        radial += x * (2 * p2)
        bent_x: Any = x * radial + r2 * p2
        bent_y: Any = y * radial + r2 * p1
        if any(self._k[8:12]):
            bent_x += r2 * (s1 + r2 * s2)
            bent_y += r2 * (s3 + r2 * s4)
        if self._tilt is None:
            return bent_x, bent_y
        tilted = [row[0] * bent_x + row[1] * bent_y + row[2] for row in self._tilt]
        return tilted[0] / tilted[2], tilted[1] / tilted[2]

    def straighten(
        self, x: NDArray[np.float64], y: NDArray[np.float64], tolerance: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the straight image coordinates that the lens bends to the given ones.

        Found by fixed-point iteration up to the tolerance; NaN where that has no end, as in the far
        corners of a model that folds over.
        """
        shape, bent = np.shape(x), np.stack([np.ravel(x), np.ravel(y)])
        straight = bent.copy()
        left = np.arange(bent.shape[1])
        for _ in range(50):
            again = np.stack(self.bend(straight[0, left], straight[1, left]))
            missing = bent[:, left] - again
            straight[:, left] += np.clip(missing, -0.2, 0.2)
            # Most of the image converges in a few rounds; only its corners go on.
            left = left[~(np.abs(missing).max(axis=0) < tolerance)]
            if not left.size:
                break
        straight[:, left] = np.nan
        return straight[0].reshape(shape), straight[1].reshape(shape)


def _tilt(tau_x: float, tau_y: float) -> NDArray[np.float64]:
    """Return the (3, 3) homography of a sensor that is tilted behind its lens."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    rotation = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array(
        [[1, 0, 0], [0, cx, sx], [0, -sx, cx]]
    )
    r13, r23, r33 = rotation[:, 2]
    return np.asarray(np.array([[r33, 0, -r13], [0, r33, -r23], [0, 0, 1]]) @ rotation)


def _fold_radius(k: NDArray[np.float64]) -> float:
    """Return the radius up to which the radial distortion grows with it; inf if it always does."""
    r = np.linspace(0.0, 10.0, 10_001)
    r2 = r * r
    divisor = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    with np.errstate(divide="ignore", invalid="ignore"):
        bent = r * (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / divisor
    folds = np.flatnonzero(~(np.diff(bent) > 0))
    return float(r[folds[0]]) if folds.size else np.inf
