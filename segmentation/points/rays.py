"""The ray through each pixel as a polynomial of its coordinates."""

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

#: Rays this close to linear ones are linear: points are stored in single precision.
_ROUNDING = 2e-6
#: Rows and columns of the lattice on which the rays are sampled, at most.
_SAMPLES = 60
#: Powers of column and row in the polynomials of a lens without distortion.
_LINEAR = ((0, 0), (1, 0), (0, 1))
#: Lenses are described by polynomials of this degree.
_DEGREE = 5
_POWERS = tuple((a, b) for a in range(_DEGREE + 1) for b in range(_DEGREE + 1 - a))


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Directions (x / z, y / z) of pixels: linear functions, or polynomials for a lens with distortion.

    Parameters
    ----------
    coefficients : (2, n + 1, n + 1) float64
        ``coefficients[k, a, b]`` belongs to ``s**a * t**b`` of x / z (k = 0) and y / z (k = 1), where
        ``s = (u - center[0]) / scale`` and ``t = (v - center[1]) / scale``. The degree n is 1 or 5.
    center : (float, float)
        Origin of s and t, pixels (u, v).
    scale : float
        Unit of s and t, pixels.
    """

    coefficients: NDArray[np.float64]
    center: tuple[float, float]
    scale: float

    @property
    def linear(self) -> bool:
        """Whether they are linear functions."""
        return len(self.coefficients[0]) == 2

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal lengths along u and v at the center, pixels; 0 where unknown, along a side of one pixel."""
        slopes = self.coefficients[0, 1, 0], self.coefficients[1, 0, 1]
        fx, fy = (self.scale / slope if slope else 0.0 for slope in slopes)
        return float(fx), float(fy)

    def at(
        self, u: NDArray[np.float64], v: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x / z and y / z of pixels; u (W,) and v (H, 1) give those of a lattice, (H, W) each."""
        s, t = (u - self.center[0]) / self.scale, (v - self.center[1]) / self.scale
        # By Horner's rule for both: `polyval` would take one step more for s.
        x, y = (
            reduce(lambda sums, each: sums * s + each, polyval(t, own.T)[::-1]) for own in self.coefficients
        )
        return x, y


def rays_through(points_m: NDArray[np.float32], valid: NDArray[np.bool_]) -> Rays:
    """Estimate the rays of a camera from points on them, by least squares.

    Parameters
    ----------
    points_m : (H, W, 3) float32
        Points on the pixel grid, meters.
    valid : (H, W) bool
        Where there is a point; those that are not in front of the camera are left out.

    Returns
    -------
    Rays
        Linear if that explains the points to rounding, else of the fifth degree.
    """
    height, width = valid.shape
    center, scale = ((width - 1) / 2, (height - 1) / 2), max(height, width) / 2
    valid = valid & (points_m[..., 2] > 0)
    rows = np.unique(np.linspace(0, height - 1, min(height, _SAMPLES)).astype(np.intp))
    columns = np.unique(np.linspace(0, width - 1, min(width, _SAMPLES)).astype(np.intp))
    lattice = np.ix_(rows, columns)
    v, u = (each[valid[lattice]] for each in np.meshgrid(rows, columns, indexing="ij"))
    points = points_m[lattice][valid[lattice]].astype(np.float64)
    if u.size < len(_LINEAR):
        v, u = np.nonzero(valid)
        points = points_m[v, u].astype(np.float64)
    if u.size == 0:
        return Rays(np.zeros((2, 2, 2)), center, scale)
    s, t = (u - center[0]) / scale, (v - center[1]) / scale
    directions = points[:, :2] / points[:, 2:]
    for powers in (_LINEAR, _POWERS):
        terms = np.stack([s**a * t**b for a, b in powers], axis=1)
        found = np.linalg.lstsq(terms, directions, rcond=None)[0]
        if np.abs(terms @ found - directions).max() <= _ROUNDING or u.size < len(_POWERS):
            break
    size = 1 + max(a for a, _ in powers)
    coefficients = np.zeros((2, size, size))
    for (a, b), pair in zip(powers, found, strict=True):
        coefficients[:, a, b] = pair
    return Rays(coefficients, center, scale)
