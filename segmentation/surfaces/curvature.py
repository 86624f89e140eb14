"""Principal curvatures of NURBS surfaces, and all nine metrics of a fit."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F64, Intp, compiled, inlined
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.surfaces.bspline import basis_matrix
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.metrics import curvature_metrics
from nurbseg.segmentation.surfaces.surface import NurbsSurface, evaluate

_Vector = F64 | tuple[float, float, float]
#: Orders along u and v of S_u, S_v, S_uu, S_uv and S_vv.
_ORDERS = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


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
    return _at_all(np.stack([evaluate(surface, u, v, *order) for order in _ORDERS], axis=1))


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
        As of `principal_curvatures`; faster, as the pixels of a row share its sums.
    """
    rows, columns = np.divmod(pixels, width)
    v, row = np.unique(rows, return_inverse=True)
    u, column = np.unique(columns, return_inverse=True)
    bases_u, bases_v = (
        np.stack([basis_matrix(knots, degree, parameters, order) for order in range(3)])
        for knots, degree, parameters in zip(
            (surface.knots_u, surface.knots_v), surface.degree, (u, v), strict=True
        )
    )
    weights = surface.weights[..., np.newaxis]
    net = np.concatenate([surface.control_points_m * weights, weights], axis=-1)
    # The control values of each row, and their derivatives along v: (3, rows, m, 4).
    blended = (bases_v @ net.reshape(len(net), -1)).reshape(3, v.size, *net.shape[1:])
    return _on_rows(blended, bases_u, row, column)


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


@compiled
def _at_all(derivatives: F64) -> tuple[F64, F64]:
    """Return the principal curvatures at N parameters, by (N, 5, 3) derivatives."""
    k1, k2 = np.empty(len(derivatives)), np.empty(len(derivatives))
    for n in range(len(derivatives)):
        k1[n], k2[n] = _from_derivatives(derivatives[n])
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
    k1, k2 = curvatures_at_pixels(fit.surface, fit.pixels, width)
    return {**fit.values, **curvature_metrics(k1, k2, config)}
