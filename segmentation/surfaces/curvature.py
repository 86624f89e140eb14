"""Principal curvatures of NURBS surfaces, and all nine metrics of a fit."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.metrics import curvature_metrics
from nurbseg.segmentation.surfaces.surface import NurbsSurface, evaluate, lattice_derivatives


def principal_curvatures(
    surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the principal curvatures of a surface at scattered parameters.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (N,) float
        Parameters: column and row, pixels.

    Returns
    -------
    k1, k2 : (N,) float64
        The larger and the smaller, one over metres, positive where the surface bends towards
        S_u x S_v; NaN where there is no tangent plane.

    References
    ----------
    .. [1] M. do Carmo, "Differential Geometry of Curves and Surfaces", 1976, section 3-3.
    """
    orders = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    return _from_derivatives(*(evaluate(surface, u, v, *order).T for order in orders))


def curvatures_at_pixels(
    surface: NurbsSurface, pixels: NDArray[np.intp], width: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the principal curvatures of a surface at some pixels.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    pixels : (N,) intp
        Flat indices into the image.
    width : int
        Columns of the image.

    Returns
    -------
    k1, k2 : (N,) float64
        As of `principal_curvatures`, computed faster, on a lattice of rows and columns.
    """
    rows, columns = np.divmod(pixels, width)
    v, row = np.unique(rows, return_inverse=True)
    u, column = np.unique(columns, return_inverse=True)
    orders = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    derivative = lattice_derivatives(surface, u, v)
    return _from_derivatives(*(derivative(*order)[:, row, column] for order in orders))


def _from_derivatives(
    Su: NDArray[np.float64],
    Sv: NDArray[np.float64],
    Suu: NDArray[np.float64],
    Suv: NDArray[np.float64],
    Svv: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the principal curvatures from (3, N) derivatives, by the two fundamental forms."""
    cross = np.cross(Su, Sv, axis=0)
    area = np.sqrt(np.einsum("cn,cn->n", cross, cross))
    E, F, G = (np.einsum("cn,cn->n", a, b) for a, b in ((Su, Su), (Su, Sv), (Sv, Sv)))
    regular = area > 1e-9 * (E + G)
    area = np.where(regular, area, 1.0)
    L, M, N = (np.einsum("cn,cn->n", d, cross) / area for d in (Suu, Suv, Svv))
    determinant = area * area
    gaussian = (L * N - M * M) / determinant  # K = k1 k2
    mean = 0.5 * (E * N - 2.0 * F * M + G * L) / determinant  # H = (k1 + k2) / 2
    root = np.sqrt(np.maximum(mean * mean - gaussian, 0.0))
    k1, k2 = mean + root, mean - root
    k1[~regular] = np.nan
    k2[~regular] = np.nan
    return k1, k2


def all_metrics(fit: Fit, width: int, config: SegmentationConfig) -> dict[Metric, float]:
    """Return all nine metrics of a fit.

    Parameters
    ----------
    fit : Fit
        The fit, which holds the residual metrics.
    width : int
        Columns of the full image, to which the fit's pixels belong.
    config : SegmentationConfig
        Its `large_curvature_per_m` is T_c.

    Returns
    -------
    dict
        Value by metric; empty where there is no surface.
    """
    if fit.surface is None:
        return {}
    k1, k2 = curvatures_at_pixels(fit.surface, fit.pixels, width)
    return {**fit.values, **curvature_metrics(k1, k2, config)}
