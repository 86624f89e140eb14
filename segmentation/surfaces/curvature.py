"""Principal curvatures of NURBS surfaces, and all nine metrics of a fit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F64, compiled, inlined
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.metrics import curvature_metrics
from nurbseg.segmentation.surfaces.surface import NurbsSurface, derivatives

_Vector = F64 | tuple[float, float, float]


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
    return _curvatures(derivatives(surface, u, v))


@compiled
def _curvatures(S: F64) -> tuple[F64, F64]:
    """Return the principal curvatures at N parameters, by (N, 6, 3) derivatives."""
    k1, k2 = np.empty(len(S)), np.empty(len(S))
    for n in range(len(S)):
        k1[n], k2[n] = _from_derivatives(S[n, 1:])
    return k1, k2


@inlined
def _from_derivatives(S: F64) -> tuple[float, float]:
    """Compute the principal curvatures by the two fundamental forms, from S_u, S_v, S_uu, S_uv and S_vv."""
    E, F, G = _dot(S[0], S[0]), _dot(S[0], S[1]), _dot(S[1], S[1])
    cross = (
        S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1],
        S[0, 2] * S[1, 0] - S[0, 0] * S[1, 2],
        S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0],
    )
    area = np.sqrt(_dot(cross, cross))
    if not area > 1e-9 * (E + G):
        return np.nan, np.nan
    L, M, N = _dot(S[2], cross) / area, _dot(S[3], cross) / area, _dot(S[4], cross) / area
    gaussian = (L * N - M * M) / (area * area)  # K = k1 k2
    mean = 0.5 * (E * N - 2.0 * F * M + G * L) / (area * area)  # H = (k1 + k2) / 2
    root = np.sqrt(max(mean * mean - gaussian, 0.0))
    return mean + root, mean - root


@inlined
def _dot(a: _Vector, b: _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


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
