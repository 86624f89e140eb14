"""SciPy's B-splines, and dense fits with them, to compare ours with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from nurbseg.segmentation.surfaces.bspline import pixel_knots


def scipy_basis(
    knots: NDArray[np.float64], degree: int, parameters: NDArray[np.float64], derivative: int = 0
) -> NDArray[np.float64]:
    """Evaluate every basis function, or a derivative, at every parameter, (M, count) float64."""
    functions = BSpline(knots, np.eye(knots.size - degree - 1), degree, extrapolate=True)
    return functions(parameters, nu=derivative)


def pixel_basis(size: int, count: int) -> NDArray[np.float64]:
    """Evaluate the functions of a fit at the pixels of a row, (size, count) float64."""
    return scipy_basis(pixel_knots(size, count), 3, np.arange(float(size)))


def dense_system(mask: NDArray[np.bool_], nu: int, nv: int) -> NDArray[np.float64]:
    """Return the design matrix of a window, a row for each pixel of the mask."""
    Bu, Bv = pixel_basis(mask.shape[1], nu), pixel_basis(mask.shape[0], nv)
    rows, columns = np.nonzero(mask)
    return np.einsum("ka,kb->kab", Bv[rows], Bu[columns]).reshape(rows.size, nv * nu)


def dense_solution(
    values: NDArray[np.float64], mask: NDArray[np.bool_], nu: int, nv: int, rcond: float | None = 1e-10
) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Return the least-squares solution of least norm about the mean, by SVD: control, fitted, rank."""
    system = dense_system(mask, nu, nv)
    points = values[:, mask].T
    center = points.mean(axis=0)
    solution, _, rank, _ = np.linalg.lstsq(system, points - center, rcond=rcond)
    return (solution + center).T.reshape(-1, nv, nu), (system @ (solution + center)).T, int(rank)
