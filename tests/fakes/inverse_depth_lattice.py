"""Inverse depth and slopes of any surface by SciPy's splines, to compare compiled loops with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy_basis import scipy_basis

from nurbseg.segmentation.surfaces.surface import NurbsSurface


def inverse_depth_lattice(
    surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return a surface's inverse depth, and its slopes, where some rows meet some columns.

    Parameters
    ----------
    surface : NurbsSurface
        Any surface over the image.
    u, v : (W,), (H,) float64
        Columns and rows, pixels. Beyond the knots the polynomials of the ends go on.

    Returns
    -------
    inverse_depth, slope_u, slope_v : (H, W) float64
        Inverse depth in 1/m and its change by one pixel along u and v.
    """
    Bu, Du = (scipy_basis(surface.knots_u, surface.degree[0], u, order).T for order in (0, 1))
    Bv, Dv = (scipy_basis(surface.knots_v, surface.degree[1], v, order) for order in (0, 1))
    weights = surface.weights
    depths = surface.control_points_m[..., 2] * weights
    w = Bv @ weights @ Bu, Bv @ weights @ Du, Dv @ weights @ Bu
    if np.ptp(depths) <= 1e-12:
        # The rational surfaces of this module: the ray's z is 1.
        return w[0] / depths[0, 0], w[1] / depths[0, 0], w[2] / depths[0, 0]
    z = Bv @ depths @ Bu, Bv @ depths @ Du, Dv @ depths @ Bu
    inverse_depth = w[0] / z[0]
    return inverse_depth, (w[1] - inverse_depth * z[1]) / z[0], (w[2] - inverse_depth * z[2]) / z[0]
