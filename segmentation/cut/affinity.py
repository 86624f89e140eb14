"""Gaussian affinities of points to landmarks, and how these are chosen for the Nystrom method."""

import math

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, Intp, compiled

#: Affinities are at least exp(-40), 4e-18: negligible beside 1, but their products are not subnormal, which
#: would be slow.
_LEAST_EXPONENT = np.float32(-40.0 / math.log(2.0))
#: Coefficients of 2^f, ln(2)^k / k!; for f in [-1/2, 1/2] the error is at most 5e-9.
_C1, _C2, _C3, _C4, _C5, _C6, _C7 = (np.float32(math.log(2.0) ** k / math.factorial(k)) for k in range(1, 8))
#: Bits of the fraction of a single-precision number, below those of the exponent.
_FRACTION_BITS = 23
#: A sample is left out where the others leave less than this of its affinity to itself, 1, unexplained.
_UNEXPLAINED = 1e-4


def affinity(
    vectors: NDArray[np.float32],
    landmarks: NDArray[np.float32],
    scale: float,
    rows: NDArray[np.intp] | None = None,
) -> NDArray[np.float32]:
    """Compute the Gaussian affinities of points to landmarks, exp(-|f - s|^2 / (2 scale^2)).

    Parameters
    ----------
    vectors : (N, D) float32
        Points f.
    landmarks : (M, D) float32
        Landmarks s.
    scale : float
        Sigma of the Gaussian, in the unit of the vectors.
    rows : (n,) intp, optional
        Rows to compute; all if None.

    Returns
    -------
    (n, M) float32
        In [exp(-40), 1], to rounding.
    """
    rows = np.arange(vectors.shape[0]) if rows is None else rows
    # One matrix product gives the exponent: [f, |f|^2, 1] . [s, -1/2, -|s|^2/2] / scale^2, of base 2.
    exponents = _with_squares(vectors, rows) @ _scaled(landmarks, 1.0 / (scale**2 * math.log(2.0))).T
    _raise_two(exponents.reshape(-1))
    return exponents


@compiled
def _with_squares(vectors: F32, rows: Intp) -> F32:
    """Append to each row its squared length and a 1."""
    dimensions = vectors.shape[1]
    taken = np.empty((rows.size, dimensions + 2), dtype=np.float32)
    for n in range(rows.size):
        vector, target = vectors[rows[n]], taken[n]
        square = np.float32(0.0)
        for k in range(dimensions):
            target[k] = vector[k]
            square += vector[k] * vector[k]
        target[dimensions] = square
        target[dimensions + 1] = np.float32(1.0)
    return taken


@compiled
def _scaled(landmarks: F32, factor: float) -> F32:
    """Return the right side of the product, a row for each landmark."""
    count, dimensions = landmarks.shape
    scaled, by = np.empty((count, dimensions + 2), dtype=np.float32), np.float32(factor)
    for n in range(count):
        square = np.float32(0.0)
        for k in range(dimensions):
            scaled[n, k] = landmarks[n, k] * by
            square += landmarks[n, k] * landmarks[n, k]
        scaled[n, dimensions] = np.float32(-0.5) * by
        scaled[n, dimensions + 1] = np.float32(-0.5) * square * by
    return scaled


@compiled
def _raise_two(exponents: F32) -> None:
    """Raise 2 to each exponent, in place; four times as fast as OpenCV's exponential, and as exact."""
    bits = exponents.view(np.int32)
    for n in range(exponents.size):
        exponent = max(exponents[n], _LEAST_EXPONENT)
        whole = np.floor(exponent + np.float32(0.5))
        f = exponent - whole
        power = f * (_C1 + f * (_C2 + f * (_C3 + f * (_C4 + f * (_C5 + f * (_C6 + f * _C7))))))
        exponents[n] = np.float32(1.0) + power
        bits[n] += np.int32(whole) << _FRACTION_BITS


def choose_landmarks(
    samples: NDArray[np.float32], scale: float, most: int
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Choose the samples that explain the affinities of all best, greedily [1]_.

    Parameters
    ----------
    samples : (N, D) float32
        Points whose affinities are Gaussian in their distance.
    scale : float
        Sigma of the Gaussian, in the unit of the points.
    most : int
        Number of landmarks, at most; fewer if these explain the others.

    Returns
    -------
    chosen : (M,) intp
        Numbers of those chosen, each the one that those before it explain least.
    inverse : (M, M) float64
        Inverse of the lower Cholesky factor of their affinities, in this order.

    References
    ----------
    .. [1] S. Fine and K. Scheinberg, "Efficient SVM training using low-rank kernel representations", Journal
       of Machine Learning Research 2, 2001 (incomplete Cholesky factorization with pivots).
    """
    exponents = _square_distances(samples)
    exponents *= -0.5 / scale**2
    return _pivoted_inverse(np.exp(exponents, out=exponents), most)


@compiled
def _square_distances(points: F32) -> F64:
    count, dimensions = points.shape
    squares = np.zeros((count, count))
    for k in range(dimensions):
        along = points[:, k].astype(np.float64)
        for i in range(count):
            target, own = squares[i], along[i]
            for j in range(count):
                target[j] += (along[j] - own) * (along[j] - own)
    return squares


@compiled
def _pivoted_inverse(A: F64, most: int) -> tuple[Intp, F64]:
    """Factorize A as L L^T with at most so many pivots, the least explained first; return them and L^-1."""
    count = A.shape[0]
    pivots, unexplained = np.empty(count, dtype=np.intp), np.ones(count)
    # Row k holds column k of L, for all samples in their original order.
    columns = np.empty((count, count))
    rank = 0
    while rank < min(count, most):
        pivot = np.argmax(unexplained)
        if unexplained[pivot] <= _UNEXPLAINED:
            break
        column, affinities = columns[rank], A[pivot]
        for i in range(count):
            column[i] = affinities[i]
        for k in range(rank):
            before, factor = columns[k], columns[k, pivot]
            for i in range(count):
                column[i] -= factor * before[i]
        column /= np.sqrt(unexplained[pivot])
        for i in range(count):
            unexplained[i] -= column[i] * column[i]
        unexplained[pivot] = -np.inf
        pivots[rank] = pivot
        rank += 1
    inverse = np.zeros((rank, rank))
    for i in range(rank):
        target, pivot = inverse[i], pivots[i]
        per_diagonal = 1.0 / columns[i, pivot]
        for k in range(i):
            source, factor = inverse[k, : k + 1], columns[k, pivot] * per_diagonal
            for j in range(k + 1):
                target[j] -= factor * source[j]
        target[i] = per_diagonal
    return pivots[:rank].copy(), inverse
