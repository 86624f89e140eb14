"""The 2-way normalized cut, by Nystrom approximation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import ssyrk
from scipy.linalg.lapack import dpstrf, dsyevr, dtrtri

from nurbseg.segmentation.config import SplittingPoint

#: A sample is left out where the others explain its affinities but for this (of the 1 to itself, squared).
_UNEXPLAINED = 1e-4
#: A second eigenvalue at rounding level belongs to points that nothing tells apart.
_LEAST_EIGENVALUE = 1e-6
#: Thresholds that are tried where the cut is made at the least Ncut.
_THRESHOLDS = 48


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """A split of points in two that can be continued to any other point.

    Parameters
    ----------
    side : (N,) bool
        Part of each point.
    ncut : float
        Normalized cut of the parts, in [0, 2]; inf where there is no cut.
    landmarks : (M, D) float32
        The sample.
    coefficients : (M,) float32
        A point is on the True side where its affinities to the sample times these sum to more than 0.
    affinity_scale : float
        Sigma of the affinity.
    reason : str
        Why there is no cut; empty where there is one.
    """

    side: NDArray[np.bool_]
    ncut: float
    landmarks: NDArray[np.float32]
    coefficients: NDArray[np.float32]
    affinity_scale: float
    reason: str = ""

    def classify(self, vectors: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Say on which side other points lie, by the Nystrom extension.

        Parameters
        ----------
        vectors : (N, D) float32
            Points in the same space as those that were cut.

        Returns
        -------
        (N,) bool
            Side of each point.
        """
        sides = np.empty(vectors.shape[0], dtype=np.bool_)
        # In blocks that stay in the cache: the affinities are read once and thrown away.
        block = max(256, (1 << 18) // max(1, self.landmarks.shape[0]))
        for start in range(0, vectors.shape[0], block):
            part = slice(start, start + block)
            kernel = affinity(vectors[part], self.landmarks, self.affinity_scale)
            np.greater(kernel @ self.coefficients, 0, out=sides[part])
        return sides


def affinity(
    vectors: NDArray[np.float32], landmarks: NDArray[np.float32], scale: float
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

    Returns
    -------
    (N, M) float32
        In [0, 1], to rounding.
    """
    n, dimensions = vectors.shape
    if n == 0 or landmarks.shape[0] == 0:
        return np.zeros((n, landmarks.shape[0]), dtype=np.float32)
    # One matrix product gives the exponent: [f, |f|^2, 1] . [s, -1/2, -|s|^2/2] / scale^2.
    left = np.empty((n, dimensions + 2), dtype=np.float32)
    left[:, :dimensions] = vectors
    np.einsum("ij,ij->i", vectors, vectors, out=left[:, dimensions])
    left[:, dimensions + 1] = 1.0
    right = np.empty((dimensions + 2, landmarks.shape[0]), dtype=np.float32)
    right[:dimensions] = landmarks.T
    right[dimensions] = -0.5
    right[dimensions + 1] = -0.5 * np.einsum("ij,ij->i", landmarks, landmarks)
    right *= np.float32(1.0 / scale**2)
    exponent = left @ right
    return np.asarray(cv2.exp(exponent, dst=exponent), dtype=np.float32)


def normalized_cut(
    vectors: NDArray[np.float32],
    *,
    samples: int,
    rng: np.random.Generator,
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
        Number of points whose affinities are computed exactly; at most N are used.
    rng : numpy.random.Generator
        Draws the sample; the same state gives the same cut.
    affinity_scale : float
        Sigma of the Gaussian affinity, in the unit of the vectors.
    splitting_point : {"zero", "kmeans", "ncut"}
        Where the second eigenvector is cut.
    points : int or None
        Number of points, the sample among them, on which the eigenproblem is set up; the others are
        classified by the extension. None for all.

    Returns
    -------
    Cut
        ``side`` (N,) bool and ``ncut`` in [0, 2]; ``ncut`` is inf and `side` all False where N < 2 or
        nothing tells the points apart.

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
    affinity_scale: float = 1.0,
    splitting_point: SplittingPoint = "zero",
    points: int | None = None,
) -> Iterator[Cut]:
    """Yield the cuts by the second eigenvector, the third, and so on, each computed when it is asked for.

    Where the second eigenvector sets a few odd points apart, one of the next often parts the surfaces.

    Parameters
    ----------
    vectors, samples, rng, affinity_scale, splitting_point, points
        As for `normalized_cut`.
    count : int
        Number of cuts, at most; the first is that of `normalized_cut`.

    Yields
    ------
    Cut
        One without parts and with a reason where there is none; no others follow where nothing tells the
        points apart.

    Raises
    ------
    ValueError
        As `normalized_cut`.
    """
    if vectors.ndim != 2 or not np.isfinite(vectors).all():
        raise ValueError(f"vectors: expected finite (N, D) values, got shape {vectors.shape}")
    vectors = np.asarray(vectors, dtype=np.float32)
    n = vectors.shape[0]
    if n < 2:
        yield _no_cut(vectors, affinity_scale, f"{n} points, 2 needed")
        return
    size = n if points is None else min(n, max(points, samples))
    chosen: NDArray[np.intp] = rng.choice(n, size=(size,), replace=False)
    landmarks = vectors[chosen[:samples]]
    if not np.any(landmarks != landmarks[0]) and not np.any(vectors != landmarks[0]):
        yield _no_cut(vectors, affinity_scale, "all points are equal")
        return

    # W = K A^-1 K^T. Samples that the others already explain make A singular and are left out; with
    # A = L L^T of the rest, W = Q Q^T where Q = K L^-T, which is not needed itself.
    landmarks, L = _independent(landmarks, affinity_scale)
    K = affinity(vectors[chosen], landmarks, affinity_scale)
    root = dtrtri(L, lower=1)[0].T
    total = root.T @ (np.ones(size, dtype=np.float32) @ K).astype(np.float64)
    b = root @ total
    # A degree holds at least the affinity of 1 to the point itself; the approximation may fall below.
    degrees = np.maximum(K @ b.astype(np.float32), np.float32(1.0))

    # S and D^-1/2 W D^-1/2 share their eigenvalues. The first eigenvector, of the constant, is known: taking
    # it out leaves the second on top also where the affinities fall apart into components.
    Kn = K / np.sqrt(degrees)[:, np.newaxis]
    upper = ssyrk(1.0, Kn.T).astype(np.float64)
    S = root.T @ (upper + np.triu(upper, 1).T) @ root
    first = total / np.linalg.norm(total)
    Sf = S @ first
    S -= np.outer(first, Sf - first * float(first @ Sf)) + np.outer(Sf, first)
    last = S.shape[0]
    eigenvalues, eigenvectors, _, _, failed = dsyevr(
        S, range="I", il=max(1, last - count + 1), iu=last, lower=1
    )
    found = np.flatnonzero(eigenvalues > _LEAST_EIGENVALUE)[::-1]
    if failed or found.size == 0:
        yield _no_cut(vectors, affinity_scale, "the affinities tell no points apart")
        return
    for each in found:
        # D^-1/2 times the eigenvector is the relaxed indicator, (K a) / (K b) at any point.
        vector = eigenvectors[:, each]
        a = root @ vector
        indicator = (K @ a.astype(np.float32)).astype(np.float64) / degrees
        orientation = _orientation(indicator[:samples])
        a, indicator = orientation * a, orientation * indicator
        threshold = _threshold(splitting_point, indicator, K, root, degrees)
        coefficients = (a - threshold * b).astype(np.float32)
        cut = Cut(np.zeros(0, dtype=np.bool_), np.inf, landmarks, coefficients, affinity_scale)
        if size == n:  # Every affinity is there already.
            side = np.empty(n, dtype=np.bool_)
            side[chosen] = K @ coefficients > 0
        else:
            side = cut.classify(vectors)
        if side.all() or not side.any():
            yield _no_cut(vectors, affinity_scale, "all points fall on one side")
        else:
            yield Cut(side, _ncut(side[chosen], K, root, degrees), landmarks, coefficients, affinity_scale)


def _no_cut(vectors: NDArray[np.float32], scale: float, reason: str) -> Cut:
    side = np.zeros(vectors.shape[0], dtype=np.bool_)
    return Cut(side, np.inf, vectors[:1], np.zeros(min(1, len(vectors)), dtype=np.float32), scale, reason)


def _independent(
    landmarks: NDArray[np.float32], scale: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Leave out samples whose affinities the others explain; return the rest and their Cholesky factor."""
    s = landmarks.astype(np.float64)
    norms = np.einsum("ij,ij->i", s, s)
    distances = np.maximum(norms[:, np.newaxis] + norms - 2.0 * (s @ s.T), 0.0)
    A = np.exp(-0.5 / scale**2 * distances)
    factor, pivots, rank, _ = dpstrf(A, tol=_UNEXPLAINED, lower=1)
    return landmarks[pivots[:rank] - 1], np.tril(factor[:rank, :rank])


def _orientation(indicator: NDArray[np.float64]) -> float:
    """Give the eigenvector, known up to its sign, the one that makes the first clear sample positive."""
    size = np.abs(indicator)
    clear = int(np.argmax(size >= 0.5 * size.max()))
    return 1.0 if indicator[clear] >= 0 else -1.0


def _threshold(
    splitting_point: SplittingPoint,
    indicator: NDArray[np.float64],
    K: NDArray[np.float32],
    root: NDArray[np.float64],
    degrees: NDArray[np.float32],
) -> float:
    """Find where the relaxed indicator is cut."""
    if splitting_point == "zero":
        return 0.0
    order = np.argsort(indicator, kind="stable")
    ascending = indicator[order]
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
    below = np.cumsum(np.add.reduceat(K[order].astype(np.float64), starts, axis=0) @ root, axis=0)
    volume = np.cumsum(np.add.reduceat(degrees[order].astype(np.float64), starts))
    total, volume_total = below[-1], volume[-1]
    inside = np.einsum("ij,ij->i", below[:-1], below[:-1])
    outside = np.einsum("ij,ij->i", total - below[:-1], total - below[:-1])
    cost = 2.0 - inside / volume[:-1] - outside / (volume_total - volume[:-1])
    best = int(edges[int(np.argmin(cost))])
    return float(0.5 * (ascending[best - 1] + ascending[best]))


def _ncut(
    side: NDArray[np.bool_],
    K: NDArray[np.float32],
    root: NDArray[np.float64],
    degrees: NDArray[np.float32],
) -> float:
    """Ncut of a partition under W = K root (K root)^T: cut(P, R) / vol(P) + cut(P, R) / vol(R)."""
    if side.all() or not side.any():
        return float(np.inf)
    weight = side.astype(np.float32)
    ones = np.ones(side.size, dtype=np.float32)
    inside, all_inside = ((each @ K).astype(np.float64) @ root for each in (weight, ones))
    volume, all_volume = float(weight @ degrees), float(ones @ degrees)
    outside = all_inside - inside
    value = 2.0 - float(inside @ inside) / volume - float(outside @ outside) / (all_volume - volume)
    return float(np.clip(value, 0.0, 2.0))


__all__ = ["Cut", "affinity", "normalized_cut", "normalized_cuts"]
