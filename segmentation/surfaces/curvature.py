"""Principal curvatures of NURBS surfaces, and all nine metrics of a fit."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F64, Intp, compiled, inlined
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.surfaces.bspline import basis_matrix
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.metrics import curvature_metrics
from nurbseg.segmentation.surfaces.surface import NurbsSurface

_Vector = F64 | tuple[float, float, float]
#: Parameters evaluated at once, to limit the memory.
_BLOCK = 1 << 16


def principal_curvatures(
    surface: NurbsSurface, u: NDArray[Any], v: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the principal curvatures of a surface at scattered parameters.

    Those of a row share its sums.

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
    u, v = np.broadcast_arrays(np.atleast_1d(u), v)
    weights = surface.weights[..., np.newaxis]
    net = np.concatenate([surface.control_points_m * weights, weights], axis=-1)
    k1, k2 = np.empty(u.size), np.empty(u.size)
    for start in range(0, u.size, _BLOCK):
        part = slice(start, start + _BLOCK)
        columns, column = np.unique(u[part], return_inverse=True)
        rows, row = np.unique(v[part], return_inverse=True)
        bases_u = np.stack([basis_matrix(surface.knots_u, surface.degree[0], columns, k) for k in range(3)])
        bases_v = np.stack([basis_matrix(surface.knots_v, surface.degree[1], rows, k) for k in range(3)])
        # The control values of each row, and their derivatives along v: (3, rows, m, 4).
        blended = (bases_v @ net.reshape(len(net), -1)).reshape(3, rows.size, *net.shape[1:])
        k1[part], k2[part] = _on_rows(blended, bases_u, row, column)
    return k1, k2


@compiled
def _on_rows(blended: F64, bases: F64, rows: Intp, columns: Intp) -> tuple[F64, F64]:
    """Return the principal curvatures at (N,) rows and columns.

    Homogeneous control values are (3, rows, m, 4), and basis functions (3, columns, m), by the order of the
    derivative first.
    """
    k1, k2 = np.empty(rows.size), np.empty(rows.size)
    # Functions that are not zero at a column.
    first, last = np.zeros(bases.shape[1], dtype=np.intp), np.zeros(bases.shape[1], dtype=np.intp)
    for c in range(bases.shape[1]):
        for k in range(bases.shape[2]):
            if bases[0, c, k] != 0.0 or bases[1, c, k] != 0.0 or bases[2, c, k] != 0.0:
                if last[c] == 0:
                    first[c] = k
                last[c] = k + 1
    A, S = np.empty((3, 3, 4)), np.empty((5, 3))
    for n in range(rows.size):
        row, column = rows[n], columns[n]
        A[:] = 0.0
        for k in range(first[column], last[column]):
            for i in range(3):
                for j in range(3 - i):
                    for x in range(4):
                        A[i, j, x] += bases[i, column, k] * blended[j, row, k, x]
        # Piegl and Tiller, eq. 4.20; w is the weight.
        w, wu, wv, wuu, wuv, wvv = A[0, 0, 3], A[1, 0, 3], A[0, 1, 3], A[2, 0, 3], A[1, 1, 3], A[0, 2, 3]
        for x in range(3):
            s = A[0, 0, x] / w
            su, sv = (A[1, 0, x] - wu * s) / w, (A[0, 1, x] - wv * s) / w
            S[0, x], S[1, x] = su, sv
            S[2, x] = (A[2, 0, x] - 2.0 * wu * su - wuu * s) / w
            S[3, x] = (A[1, 1, x] - wu * sv - wv * su - wuv * s) / w
            S[4, x] = (A[0, 2, x] - 2.0 * wv * sv - wvv * s) / w
        k1[n], k2[n] = _from_derivatives(S)
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
