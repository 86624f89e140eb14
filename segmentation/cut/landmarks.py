"""The landmarks of the Nystrom method, and the inverse Cholesky factor of their affinities."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled

#: A sample is left out where the others leave less than this of its affinity to itself, 1, unexplained.
_UNEXPLAINED = 1e-4


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
def _square_distances(points: NDArray[np.float32]) -> NDArray[np.float64]:
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
def _pivoted_inverse(A: NDArray[np.float64], most: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
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
