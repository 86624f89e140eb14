"""NURBS surfaces over the image: their points, derivatives and normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, Intp, compiled
from nurbseg.segmentation.surfaces.bspline import basis_matrices

_T = TypeVar("_T")

#: Points evaluated at once, to limit the memory.
_BLOCK = 1 << 15
#: Orders along u and v of the derivatives.
_ORDERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class NurbsSurface:
    """A non-uniform rational B-spline surface whose parameters are pixels: u = column, v = row (eq. 4).

    Parameters
    ----------
    degree : (int, int)
        Along u and v.
    knots_u : (m + p + 1,) float64
        Knot vector along u, pixels of the full image.
    knots_v : (n + q + 1,) float64
        Knot vector along v, pixels of the full image.
    control_points_m : (n, m, 3) float64
        Control points, meters; the first axis goes with v, the second with u.
    weights : (n, m) float64
        Weight of each control point, more than 0; all 1 for the paper's surfaces.
    window : (int, int, int, int)
        Pixels that the surface spans: first row, first column, and one past the last of each.

    Raises
    ------
    ValueError
        If shapes do not match or a weight is not positive.
    """

    degree: tuple[int, int]
    knots_u: NDArray[np.float64]
    knots_v: NDArray[np.float64]
    control_points_m: NDArray[np.float64]
    weights: NDArray[np.float64]
    window: tuple[int, int, int, int]

    def __repr__(self) -> str:
        rows, columns = self.weights.shape
        return f"NurbsSurface(degree {self.degree}, {columns}x{rows} control points, window {self.window})"

    def __post_init__(self) -> None:
        p, q = self.degree
        n, m = self.weights.shape
        if self.control_points_m.shape != (n, m, 3):
            raise ValueError(
                f"control_points_m: expected {(n, m, 3)} as weights, got {self.control_points_m.shape}"
            )
        for name, knots, size in (("knots_u", self.knots_u, m + p + 1), ("knots_v", self.knots_v, n + q + 1)):
            if knots.shape != (size,):
                raise ValueError(f"{name}: expected ({size},) for degree {self.degree}, got {knots.shape}")
        if not self.weights.min() > 0:
            raise ValueError(f"weights: expected positive weights, got {float(self.weights.min())}")
        for array in (self.knots_u, self.knots_v, self.control_points_m, self.weights):
            array.setflags(write=False)


def unchecked(kind: type[_T], *fields: Any) -> _T:
    """Return a value with slots of fields that are known to fit; its arrays are read-only already."""
    value = object.__new__(kind)
    for name, field in zip(kind.__slots__, fields, strict=True):  # type: ignore[attr-defined]
        object.__setattr__(value, name, field)
    return value


def derivatives(surface: NurbsSurface, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
    """Evaluate a surface and its partial derivatives of up to the second order.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (...) float or int
        Parameters: column and row, pixels, broadcast against each other. Beyond the knots the surface is
        extrapolated.

    Returns
    -------
    (..., 6, 3) float64
        S, S_u, S_v, S_uu, S_uv and S_vv, in meters per pixel to the power of the order.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, eq. 4.11 and 4.20.
    """
    u, v = np.broadcast_arrays(u, v)
    weights = surface.weights[..., np.newaxis]
    net = np.concatenate([surface.control_points_m * weights, weights], axis=-1)
    found = np.empty((u.size, len(_ORDERS), 3))
    for start in range(0, u.size, _BLOCK):
        part = slice(start, start + _BLOCK)
        # Parameters of a row share its sums.
        columns, column = np.unique(u.ravel()[part], return_inverse=True)
        rows, row = np.unique(v.ravel()[part], return_inverse=True)
        bases_u = basis_matrices(surface.knots_u, surface.degree[0], columns, 3)
        bases_v = basis_matrices(surface.knots_v, surface.degree[1], rows, 3)
        # The control values of each row, and their derivatives along v: (3, rows, m, 4).
        blended = (bases_v @ net.reshape(len(net), -1)).reshape(3, rows.size, *net.shape[1:])
        found[part] = _on_rows(blended, bases_u, row, column)
    return found.reshape(*u.shape, len(_ORDERS), 3)


def evaluate(
    surface: NurbsSurface, u: NDArray[Any], v: NDArray[Any], du: int = 0, dv: int = 0
) -> NDArray[np.float64]:
    """Evaluate a surface, or a partial derivative of up to the second order.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (...) float or int
        Parameters: column and row, pixels, broadcast against each other. Beyond the knots the surface is
        extrapolated.
    du, dv : int
        Order of the derivative along u and v, together at most 2.

    Returns
    -------
    (..., 3) float64
        Points in meters, or derivatives in meters per pixel to the power of the order.
    """
    if (du, dv) not in _ORDERS:
        raise ValueError(f"du, dv: expected orders of 0 to 2 together, got {du} and {dv}")
    return derivatives(surface, u, v)[..., _ORDERS.index((du, dv)), :].copy()


def normals(surface: NurbsSurface, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
    """Return the unit normals of a surface, S_u x S_v, which look away from the camera.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (...) float or int
        Parameters: column and row, pixels, broadcast against each other.

    Returns
    -------
    (..., 3) float64
        Unit vectors; NaN where the surface has no tangent plane.
    """
    S = derivatives(surface, u, v)
    cross = np.cross(S[..., 1, :], S[..., 2, :])
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    unit: NDArray[np.float64] = np.divide(cross, length, out=np.full_like(cross, np.nan), where=length > 0)
    return unit


@compiled
def _on_rows(blended: F64, bases: F64, rows: Intp, columns: Intp) -> F64:
    """Return the derivatives at (N,) rows and columns: (N, 6, 3), as `derivatives`.

    Homogeneous control values are (3, rows, m, 4), and basis functions (3, columns, m), by the order of the
    derivative first.
    """
    # Functions that are not zero at a column.
    first, last = np.zeros(bases.shape[1], dtype=np.intp), np.zeros(bases.shape[1], dtype=np.intp)
    for c in range(bases.shape[1]):
        for k in range(bases.shape[2]):
            if bases[0, c, k] != 0.0 or bases[1, c, k] != 0.0 or bases[2, c, k] != 0.0:
                if last[c] == 0:
                    first[c] = k
                last[c] = k + 1
    A, S = np.empty((3, 3, 4)), np.empty((rows.size, 6, 3))
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
            S[n, 0, x], S[n, 1, x], S[n, 2, x] = s, su, sv
            S[n, 3, x] = (A[2, 0, x] - 2.0 * wu * su - wuu * s) / w
            S[n, 4, x] = (A[1, 1, x] - wu * sv - wv * su - wuv * s) / w
            S[n, 5, x] = (A[0, 2, x] - 2.0 * wv * sv - wvv * s) / w
    return S
