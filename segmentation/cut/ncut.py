"""The 2-way normalized cut, by Nystrom approximation."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dsyevr

from nurbseg.common.compiled import F32, F64, Intp, compiled
from nurbseg.segmentation.config import SplittingPoint
from nurbseg.segmentation.cut.affinity import affinity, choose_landmarks

#: Least second eigenvalue, above rounding; below it the points are indistinguishable.
_LEAST_EIGENVALUE = 1e-6
#: Error of eigenvalues; their vectors are as exact with it, after less bisection.
_TOLERANCE = 1e-10
#: Thresholds that are tried for the least Ncut.
_THRESHOLDS = 48


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """A split of points in two that can be extended to any other point.

    Parameters
    ----------
    side : (N,) bool
        Part of each point.
    landmarks : (M, D) float32
        The sample.
    coefficients : (M,) float32
        A point is on the True side where its affinities to the sample, times these, sum to more than 0.
    affinity_scale : float
        Sigma of the affinity.
    reason : str
        Why there is no cut; empty if there is one.
    """

    side: NDArray[np.bool_]
    landmarks: NDArray[np.float32]
    coefficients: NDArray[np.float32]
    affinity_scale: float
    reason: str = ""

    def classify(
        self, vectors: NDArray[np.float32], rows: NDArray[np.intp] | None = None
    ) -> NDArray[np.bool_]:
        """Return the side of other points, by the Nystrom extension.

        Parameters
        ----------
        vectors : (N, D) float32
            Feature vectors, normalized as those that were cut.
        rows : (n,) intp, optional
            Rows to classify; all if None.

        Returns
        -------
        (n,) bool
            Side of each point.
        """
        rows = np.arange(vectors.shape[0]) if rows is None else rows
        sides = np.empty(rows.size, dtype=np.bool_)
        # In blocks whose affinities fit into the cache.
        block = max(256, (1 << 18) // max(1, self.landmarks.shape[0]))
        for start in range(0, rows.size, block):
            part = slice(start, start + block)
            kernel = affinity(vectors, self.landmarks, self.affinity_scale, rows[part])
            np.greater(kernel @ self.coefficients, 0, out=sides[part])
        return sides


def normalized_cut(
    vectors: NDArray[np.float32],
    *,
    samples: int,
    rng: np.random.Generator,
    landmarks: int | None = None,
    affinity_scale: float = 1.0,
    splitting_point: SplittingPoint = "zero",
    points: int | None = None,
) -> Cut:
    """Split points in two at the minimum normalized cut, by Nystrom approximation.

    Parameters
    ----------
    vectors : (N, D) float32
        Feature vectors, dimensionless (eq. 3).
    samples : int
        Number of points drawn at random whose affinities are computed exactly; at most N are used.
    rng : numpy.random.Generator
        Draws the sample; the same state gives the same cut.
    landmarks : int or None
        Number of samples, at most, that the approximation uses: those that explain the affinities of the
        others best. None for all.
    affinity_scale : float
        Sigma of the Gaussian affinity, in the unit of the vectors.
    splitting_point : {"zero", "kmeans", "ncut"}
        Where the second eigenvector is cut.
    points : int or None
        Number of points, including the sample, on which the eigenproblem is set up; the others are classified
        by the extension. None for all.

    Returns
    -------
    Cut
        Its `side` is all False, and it has a reason, if N < 2 or the points are indistinguishable.

    Raises
    ------
    ValueError
        If `vectors` is not (N, D) or holds a value that is not finite.

    References
    ----------
    .. [1] J. Shi and J. Malik, "Normalized cuts and image segmentation", IEEE TPAMI 22(8), 2000.
    .. [2] C. Fowlkes et al., "Spectral grouping using the Nystrom method", IEEE TPAMI 26(2), 2004.
    """
    return next(
        normalized_cuts(
            vectors,
            count=1,
            samples=samples,
            rng=rng,
            landmarks=landmarks,
            affinity_scale=affinity_scale,
            splitting_point=splitting_point,
            points=points,
        )
    )


def normalized_cuts(
    vectors: NDArray[np.float32],
    *,
    count: int,
    samples: int,
    rng: np.random.Generator,
    landmarks: int | None = None,
    affinity_scale: float = 1.0,
    splitting_point: SplittingPoint = "zero",
    points: int | None = None,
) -> Iterator[Cut]:
    """Yield the cuts by the second eigenvector, the third, and so on, lazily.

    Where the second eigenvector separates a few outliers, one of the next often separates the surfaces.

    Parameters
    ----------
    vectors, samples, rng, landmarks, affinity_scale, splitting_point, points
        As for `normalized_cut`.
    count : int
        Number of cuts, at most; the first is that of `normalized_cut`.

    Yields
    ------
    Cut
        Without parts, but with a reason, if there is none; no others follow if the points are
        indistinguishable.

    Raises
    ------
    ValueError
        As `normalized_cut`.
    """
    vectors = np.ascontiguousarray(vectors, dtype=np.float32)
    finite, equal = _examine(vectors) if vectors.ndim == 2 else (False, False)
    if not finite:
        raise ValueError(f"vectors: expected finite (N, D) values, got shape {vectors.shape}")
    n = vectors.shape[0]
    if n < 2:
        yield _no_cut(vectors, affinity_scale, f"{n} points, 2 needed")
        return
    if equal:
        yield _no_cut(vectors, affinity_scale, "all points are equal")
        return
    size = n if points is None else min(n, max(points, samples))
    chosen: NDArray[np.intp] = rng.choice(n, size=(size,), replace=False)
    sample = chosen[:samples]
    drawn = vectors[sample]
    if size == n:
        chosen = np.arange(n)
    else:
        sample = np.arange(min(samples, size))

    # W = K A^-1 K^T. Samples that the others explain would make A singular; they are left out. With
    # A = L L^T, W = Q Q^T where Q = K L^-T, which is not needed itself.
    numbers, inverse = choose_landmarks(drawn, affinity_scale, landmarks or samples)
    kept = drawn[numbers]
    K = affinity(vectors, kept, affinity_scale, chosen)
    total = inverse @ (np.ones(size, dtype=np.float32) @ K).astype(np.float64)
    b = total @ inverse

    # S and D^-1/2 W D^-1/2 share their eigenvalues. The first eigenvector, of the constant, is known:
    # deflation leaves the second on top also where the affinity graph is not connected.
    inv_sqrt_degree = _divide_by_roots(K, b.astype(np.float32))
    S = inverse @ (K.T @ K).astype(np.float64) @ inverse.T
    _deflate(S, total / np.linalg.norm(total))
    last = S.shape[0]
    # Fewer are found where many eigenvalues are equal.
    eigenvalues, eigenvectors, known, _, failed = dsyevr(
        S.T, range="I", il=max(1, last - count + 1), iu=last, abstol=_TOLERANCE, lower=1, overwrite_a=1
    )
    found = [each for each in reversed(range(known)) if eigenvalues[each] > _LEAST_EIGENVALUE]
    if failed or not found:
        yield _no_cut(vectors, affinity_scale, "the affinities of all points are alike")
        return
    for each in found:
        # D^-1/2 times the eigenvector is the relaxed indicator, (K a) / (K b) at any point.
        a = eigenvectors[:, each] @ inverse
        sums = K @ a.astype(np.float32)
        if _needs_sign_flip(sums, inv_sqrt_degree, sample):
            a, sums = -a, -sums
        if splitting_point != "zero":
            a -= _threshold(splitting_point, sums * inv_sqrt_degree, K, inverse, inv_sqrt_degree) * b
            sums = K @ a.astype(np.float32)
        side = np.ones(n, dtype=np.bool_)
        cut = Cut(side, kept, a.astype(np.float32), affinity_scale)
        side[chosen] = False
        others = np.flatnonzero(side)
        side[chosen], side[others] = sums > 0, cut.classify(vectors, others)
        if side.all() or not side.any():
            yield _no_cut(vectors, affinity_scale, "all points fall on one side")
        else:
            yield cut


@compiled
def _examine(vectors: F32) -> tuple[bool, bool]:
    """Return whether vectors are finite, and whether they are all equal."""
    flat, dimensions, infinite, same = vectors.reshape(-1), vectors.shape[1], 0, vectors.shape[1]
    # By index: a loop over the elements themselves is not vectorized.
    for n in range(flat.size):
        infinite += not abs(flat[n]) < np.inf
    while same < flat.size and flat[same] == flat[same - dimensions]:
        same += 1
    return infinite == 0, same >= flat.size


@compiled
def _deflate(S: F64, first: F64) -> None:
    """Deflate a symmetric matrix by a unit vector: (1 - f f^T) S (1 - f f^T), in place."""
    size = first.size
    Sf = np.zeros(size)
    for i in range(size):
        for j in range(size):
            Sf[i] += S[i, j] * first[j]
    fSf = 0.0
    for i in range(size):
        fSf += first[i] * Sf[i]
    for i in range(size):
        for j in range(size):
            S[i, j] -= first[i] * (Sf[j] - first[j] * fSf) + Sf[i] * first[j]


def _no_cut(vectors: NDArray[np.float32], scale: float, reason: str) -> Cut:
    side = np.zeros(vectors.shape[0], dtype=np.bool_)
    return Cut(side, vectors[:1], np.zeros(min(1, len(vectors)), dtype=np.float32), scale, reason)


@compiled
def _divide_by_roots(K: F32, b: F32) -> F32:
    """Divide each point's affinities by the root of its degree, their sum times b; return 1 over roots."""
    inv_sqrt_degree = np.empty(K.shape[0], dtype=np.float32)
    # A loop for each step: one for all takes nearly three times as long.
    for n in range(K.shape[0]):
        inv_sqrt_degree[n] = np.float32(0.0)
        for k in range(K.shape[1]):
            inv_sqrt_degree[n] += K[n, k] * b[k]
    for n in range(K.shape[0]):
        # It holds at least the affinity of 1 to the point itself; the approximation may fall below.
        inv_sqrt_degree[n] = np.float32(1.0) / np.sqrt(max(inv_sqrt_degree[n], np.float32(1.0)))
    for n in range(K.shape[0]):
        for k in range(K.shape[1]):
            K[n, k] *= inv_sqrt_degree[n]
    return inv_sqrt_degree


@compiled
def _needs_sign_flip(sums: F32, inv_sqrt_degree: F32, sample: Intp) -> bool:
    """Return whether an indicator, known up to its sign, is negative at the first sample clearly not 0."""
    largest = np.float32(0.0)
    for n in sample:
        largest = max(largest, abs(sums[n] * inv_sqrt_degree[n]))
    for n in sample:
        if abs(sums[n] * inv_sqrt_degree[n]) >= np.float32(0.5) * largest:
            return bool(sums[n] < 0)
    return False


def _threshold(
    splitting_point: SplittingPoint,
    indicator: NDArray[np.float32],
    K: NDArray[np.float32],
    inverse: NDArray[np.float64],
    inv_sqrt_degree: NDArray[np.float32],
) -> float:
    """Find where the relaxed indicator is cut: by 2-means, or at the least Ncut."""
    order = np.argsort(indicator, kind="stable")
    ascending = indicator[order].astype(np.float64)
    if splitting_point == "kmeans":
        # In one dimension the best 2-means is a threshold: least scatter = greatest sum of squared sums
        # over counts.
        sums = np.cumsum(ascending - ascending.mean())
        counts = np.arange(1, ascending.size)
        score = sums[:-1] ** 2 * (1.0 / counts + 1.0 / (ascending.size - counts))
        score[ascending[1:] <= ascending[:-1]] = -1.0
        best = int(np.argmax(score))
        return float(0.5 * (ascending[best] + ascending[best + 1]))
    # Least Ncut (SM00, section 3.1) over thresholds at equal counts of points, from the sums of each bin.
    edges = np.unique((np.arange(1, _THRESHOLDS) * ascending.size) // _THRESHOLDS)
    edges = edges[(edges > 0) & (edges < ascending.size)]
    edges = edges[ascending[edges] > ascending[edges - 1]]
    if edges.size == 0:
        return 0.0
    starts = np.concatenate([[0], edges])
    weights = inv_sqrt_degree[order].astype(np.float64) ** -2
    sums = np.add.reduceat(np.sqrt(weights)[:, np.newaxis] * K[order], starts, axis=0)
    below = np.cumsum(sums @ inverse.T, axis=0)
    volume = np.cumsum(np.add.reduceat(weights, starts))
    total, volume_total = below[-1], volume[-1]
    inside = np.einsum("ij,ij->i", below[:-1], below[:-1])
    outside = np.einsum("ij,ij->i", total - below[:-1], total - below[:-1])
    cost = 2.0 - inside / volume[:-1] - outside / (volume_total - volume[:-1])
    best = int(edges[int(np.argmin(cost))])
    return float(0.5 * (ascending[best - 1] + ascending[best]))
