"""Principal curvatures of NURBS surfaces, and all nine metrics of a fit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.metrics import curvature_metrics
from nurbseg.segmentation.surfaces.surface import NurbsSurface, derivatives


def principal_curvatures(
    surface: NurbsSurface, u: NDArray[Any], v: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the principal curvatures of a surface at scattered parameters.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (N,) float or int
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
    S = derivatives(surface, u, v)
    E, F, G = (np.einsum("...i,...i", S[..., a, :], S[..., b, :]) for a, b in ((1, 1), (1, 2), (2, 2)))
    cross = np.cross(S[..., 1, :], S[..., 2, :])
    area = np.linalg.norm(cross, axis=-1)
    area = np.where(area > 1e-9 * (E + G), area, np.nan)
    L, M, N = np.einsum("...ki,...i->k...", S[..., 3:, :], cross) / area
    gaussian = (L * N - M * M) / (area * area)  # K = k1 k2
    mean = 0.5 * (E * N - 2.0 * F * M + G * L) / (area * area)  # H = (k1 + k2) / 2
    root = np.sqrt(np.maximum(mean * mean - gaussian, 0.0))
    return mean + root, mean - root


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
    k1, k2 = principal_curvatures(fit.surface, fit.pixels % width, fit.pixels // width)
    return {**fit.values, **curvature_metrics(k1, k2, config)}
