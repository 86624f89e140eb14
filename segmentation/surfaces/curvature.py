"""Principal curvatures of NURBS surfaces, and all metrics of a fit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, compiled, inlined
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.metrics import curvature_metrics
from nurbseg.segmentation.surfaces.surface import NurbsSurface, derivatives

_Vector = F64 | tuple[float, float, float]


def principal_curvatures(
    surface: NurbsSurface, u: NDArray[Any], v: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the principal curvatures of a surface.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (...) float or int
        Parameters: column and row, pixels, broadcast against each other.

    Returns
    -------
    k1, k2 : (...) float64
        The larger and the smaller, one over meters, positive where the surface bends toward
        S_u x S_v; NaN where there is no tangent plane.

    References
    ----------
    .. [1] M. do Carmo, "Differential Geometry of Curves and Surfaces", 1976, section 3-3.
    """
    S = derivatives(surface, u, v)
    k1, k2 = _curvatures(S.reshape(-1, *S.shape[-2:]))
    return k1.reshape(S.shape[:-2]), k2.reshape(S.shape[:-2])


@compiled
def _curvatures(S: F64) -> tuple[F64, F64]:
    """Compute the principal curvatures by the two fundamental forms, from (N, 6, 3) derivatives."""
    k1, k2 = np.full(len(S), np.nan), np.full(len(S), np.nan)
    for n in range(len(S)):
        Su, Sv = S[n, 1], S[n, 2]
        E, F, G = _dot(Su, Su), _dot(Su, Sv), _dot(Sv, Sv)
        cross = Su[1] * Sv[2] - Su[2] * Sv[1], Su[2] * Sv[0] - Su[0] * Sv[2], Su[0] * Sv[1] - Su[1] * Sv[0]
        area = np.sqrt(_dot(cross, cross))
        if area > 1e-9 * (E + G):
            L, M, N = _dot(S[n, 3], cross) / area, _dot(S[n, 4], cross) / area, _dot(S[n, 5], cross) / area
            gaussian = (L * N - M * M) / (area * area)  # K = k1 k2
            mean = 0.5 * (E * N - 2.0 * F * M + G * L) / (area * area)  # H = (k1 + k2) / 2
            root = np.sqrt(max(mean * mean - gaussian, 0.0))
            k1[n], k2[n] = mean + root, mean - root
    return k1, k2


@inlined
def _dot(a: _Vector, b: _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def all_metrics(fit: Fit, width: int, config: SegmentationConfig) -> dict[Metric, float]:
    """Return all metrics of a fit.

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
