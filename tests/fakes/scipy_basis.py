"""SciPy's B-splines, to compare ours with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline


def scipy_basis(
    knots: NDArray[np.float64], degree: int, parameters: NDArray[np.float64], derivative: int = 0
) -> NDArray[np.float64]:
    """Evaluate every basis function, or a derivative, at every parameter, (M, count) float64."""
    functions = BSpline(knots, np.eye(knots.size - degree - 1), degree, extrapolate=True)
    return functions(parameters, nu=derivative)
