"""NURBS surfaces over the image: their points, derivatives and normals."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import product
from math import comb

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.surfaces.bspline import basis_matrix

#: Scattered points evaluated at once, to limit the memory.
_BLOCK = 16_384

#: Evaluates control values (C, n, m), or their derivative of some order along u and v, at some parameters.
_At = Callable[[NDArray[np.float64], int, int], NDArray[np.float64]]


@dataclass(frozen=True, slots=True, eq=False)
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
        Control points, metres; the first axis goes with v, the second with u.
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


def evaluate(
    surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64], du: int = 0, dv: int = 0
) -> NDArray[np.float64]:
    """Evaluate a surface, or a partial derivative of up to the second order, at scattered parameters.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (N,) float
        Parameters: column and row, pixels. Beyond the knots the surface is extrapolated.
    du, dv : int
        Order of the derivative along u and v, together at most 2.

    Returns
    -------
    (N, 3) float64
        Points in metres, or derivatives in metres per pixel to the power of the order.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, eq. 4.11 and 4.20.
    """
    u = np.atleast_1d(np.asarray(u, dtype=np.float64))
    v = np.atleast_1d(np.asarray(v, dtype=np.float64))
    if u.shape != v.shape or u.ndim != 1:
        raise ValueError(f"u, v: expected two (N,) arrays of equal length, got {u.shape} and {v.shape}")
    points = np.empty((u.size, 3))
    for start in range(0, u.size, _BLOCK):
        part = slice(start, start + _BLOCK)

        def at(net: NDArray[np.float64], k: int, m: int, part: slice = part) -> NDArray[np.float64]:
            Bu = basis_matrix(surface.knots_u, surface.degree[0], u[part], k)
            Bv = basis_matrix(surface.knots_v, surface.degree[1], v[part], m)
            return np.asarray(np.einsum("cnk,nk->cn", Bv @ net, Bu))

        points[part] = _derivative(surface, at, du, dv).T
    return points


def evaluate_lattice(
    surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64], du: int = 0, dv: int = 0
) -> NDArray[np.float64]:
    """Evaluate a surface or its derivative on the lattice of rows v (H,) and columns u (W,), as `evaluate`.

    Returns
    -------
    (H, W, 3) float64
        As of `evaluate`.
    """
    u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)

    def at(net: NDArray[np.float64], k: int, m: int) -> NDArray[np.float64]:
        Bu = basis_matrix(surface.knots_u, surface.degree[0], u, k)
        Bv = basis_matrix(surface.knots_v, surface.degree[1], v, m)
        return np.asarray(Bv @ net @ Bu.T)

    return np.moveaxis(_derivative(surface, at, du, dv), 0, -1)


def normals(surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit normals of a surface, S_u x S_v, which look away from the camera.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (N,) float
        Parameters: column and row, pixels.

    Returns
    -------
    (N, 3) float64
        Unit vectors; NaN where the surface has no tangent plane.
    """
    cross = np.cross(evaluate(surface, u, v, 1, 0), evaluate(surface, u, v, 0, 1))
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    unit: NDArray[np.float64] = np.divide(cross, length, out=np.full_like(cross, np.nan), where=length > 0)
    return unit


def _derivative(surface: NurbsSurface, at: _At, du: int, dv: int) -> NDArray[np.float64]:
    """Evaluate eq. 4, or its partial derivative of an order: (3, ...) coordinates.

    `at` gives the coordinates of a net of control values, or their derivatives, at the parameters.
    """
    if du < 0 or dv < 0 or du + dv > 2:
        raise ValueError(f"du, dv: expected orders of 0 to 2 together, got {du} and {dv}")
    weights = surface.weights
    if (weights == weights[0, 0]).all():
        # Equal weights cancel: the surface is a polynomial spline.
        return at(np.moveaxis(surface.control_points_m, -1, 0), du, dv)
    weighted = surface.control_points_m * weights[..., np.newaxis]
    net = np.concatenate([np.moveaxis(weighted, -1, 0), weights[np.newaxis]])

    @cache
    def homogeneous(k: int, m: int) -> NDArray[np.float64]:
        return at(net, k, m)

    @cache
    def derivative(k: int, m: int) -> NDArray[np.float64]:
        # Piegl and Tiller, eq. 4.20.
        total = homogeneous(k, m)[:3]
        for j, i in list(product(range(m + 1), range(k + 1)))[1:]:
            total = total - comb(k, i) * comb(m, j) * homogeneous(i, j)[3] * derivative(k - i, m - j)
        return np.asarray(total / homogeneous(0, 0)[3])

    return derivative(du, dv)
