"""Symmetric banded systems: Cholesky factor and solution."""

import numpy as np

from nurbseg.common.compiled import F64, compiled, inlined_once


@compiled
def dot(a: F64, b: F64) -> float:
    """Return the dot product of two rows."""
    total = 0.0
    for n in range(a.size):
        total += a[n] * b[n]
    return total


@inlined_once
def factorize(band: F64) -> bool:
    """Replace a symmetric band by its Cholesky factor.

    Parameters
    ----------
    band : (N, W) float64
        Entry ``[n, k]`` is that of row ``n + k`` and column ``n``; replaced by the factor's, and by one over
        it on the diagonal.

    Returns
    -------
    bool
        False where the matrix is not positive definite.
    """
    size, width = band.shape
    for n in range(size):
        if not band[n, 0] > 0.0:
            return False
        per_pivot = 1.0 / np.sqrt(band[n, 0])
        reach = min(width, size - n)
        band[n, 0] = per_pivot
        for k in range(1, reach):
            band[n, k] *= per_pivot
        # By index: a slice of an array costs as much as ten of these steps.
        for k in range(1, reach):
            factor = band[n, k]
            if factor != 0.0:
                for m in range(reach - k):
                    band[n + k, m] -= factor * band[n, k + m]
    return True


@inlined_once
def substitute(factor: F64, x: F64) -> None:
    """Solve a system in place.

    Parameters
    ----------
    factor : (N, W) float64
        As `factorize` leaves it.
    x : (N,) float64
        The right-hand side, replaced by the solution.
    """
    size, width = factor.shape
    for n in range(size):
        reach = min(width, size - n)
        x[n] *= factor[n, 0]
        value = x[n]
        for k in range(1, reach):
            x[n + k] -= value * factor[n, k]
    for n in range(size - 1, -1, -1):
        reach = min(width, size - n)
        x[n] = (x[n] - dot(factor[n, 1:reach], x[n + 1 : n + reach])) * factor[n, 0]
