"""Flat spectral clustering of a frame, and the unsupervised choice of lambda (Dal Mutto et al., 2012).

A baseline for the recursive method: the same vectors and Nystrom normalized cuts, but a single clustering
into a given number of segments instead of a tree of fits.
"""

from dataclasses import replace
from operator import itemgetter

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.affinity import affinity
from nurbseg.segmentation.cut.features import features
from nurbseg.segmentation.points.registration import PointMap

#: Weights of geometry against color that are tried.
LAMBDAS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
_EIGENVALUE_SHARE = 1e-6
#: Width of the band around a segment that counts as its surroundings, as a share of the image's width.
_BAND_SHARE = 0.02


def spectral_embedding(
    vectors: NDArray[np.float32],
    *,
    dimensions: int,
    samples: int,
    rng: np.random.Generator,
    affinity_scale: float = 1.0,
) -> NDArray[np.float32]:
    """Embed points by the leading eigenvectors of their normalized affinity matrix, by Nystrom.

    Parameters
    ----------
    vectors : (N, D) float32
        Feature vectors, dimensionless; N at least 2.
    dimensions : int
        Number of eigenvectors; fewer are returned if the sample has a lower rank.
    samples : int
        Number of points whose affinities are computed exactly.
    rng : numpy.random.Generator
        Draws the sample.
    affinity_scale : float
        Sigma of the Gaussian affinity.

    Returns
    -------
    (N, E) float32
        Rows of unit length, E at most `dimensions`.

    References
    ----------
    .. [1] C. Fowlkes et al., "Spectral grouping using the Nystrom method", IEEE TPAMI 26(2), 2004.
    """
    landmarks = vectors[rng.choice(len(vectors), size=min(samples, len(vectors)), replace=False)]
    A = affinity(landmarks, landmarks, affinity_scale).astype(np.float64)
    eigenvalues, U = np.linalg.eigh(0.5 * (A + A.T))
    kept = eigenvalues > _EIGENVALUE_SHARE * eigenvalues[-1]
    Q = affinity(vectors, landmarks, affinity_scale) @ (U[:, kept] / np.sqrt(eigenvalues[kept])).astype(
        np.float32
    )
    degrees = np.maximum(Q @ Q.sum(axis=0), np.float32(1.0))
    Q /= np.sqrt(degrees)[:, np.newaxis]
    eigenvalues, leading = np.linalg.eigh((Q.T @ Q).astype(np.float64))
    kept = np.flatnonzero(eigenvalues > _EIGENVALUE_SHARE)[::-1][:dimensions]
    # Q V holds the eigenvectors times the roots of their eigenvalues, which would weight them.
    embedded = Q @ (leading[:, kept] / np.sqrt(eigenvalues[kept])).astype(np.float32)
    norms = np.linalg.norm(embedded, axis=1, keepdims=True)
    return np.asarray(embedded / np.maximum(norms, 1e-12), dtype=np.float32)


def flat_clusters(
    cloud: PointMap, config: SegmentationConfig, *, clusters: int, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Cluster a frame into a given number of segments.

    Parameters
    ----------
    cloud : PointMap
        The frame.
    config : SegmentationConfig
        Its lambda, samples and affinity scale are used.
    clusters : int
        Number of segments.
    rng : numpy.random.Generator
        Draws the sample and the initial centers.

    Returns
    -------
    (H, W) uint16
        1 to `clusters`; 0 without a point.

    References
    ----------
    .. [1] C. Dal Mutto, P. Zanuttigh, G. M. Cortelazzo, "Fusion of geometry and color information for
       scene segmentation", IEEE JSTSP 6(5), 2012.
    """
    labels = np.zeros(cloud.valid.shape, np.uint16)
    vectors = features(cloud, config)
    if len(vectors) <= clusters:
        labels[cloud.valid] = 1
        return labels
    embedded = spectral_embedding(
        vectors,
        dimensions=clusters,
        samples=config.samples,
        rng=rng,
        affinity_scale=config.affinity_scale,
    )
    _, cluster = kmeans2(embedded, clusters, iter=20, minit="++", rng=rng)
    labels[cloud.valid] = cluster + 1
    return labels


def unsupervised_quality(labels: NDArray[np.uint16], cloud: PointMap) -> float:
    """Score a segmentation without ground truth: contrast to surroundings minus dispersion.

    Both are computed for color and for position, in units of the frame's deviations (sigma_c, sigma_g), and
    averaged over the two and over segments, weighted by size. The surroundings of a segment are the other
    points in a band around it.

    Parameters
    ----------
    labels : (H, W) uint16
        0 for no segment.
    cloud : PointMap
        The frame.

    Returns
    -------
    float
        Dimensionless, greater is better; -inf with fewer than two segments.
    """
    vectors = np.zeros((*labels.shape, 6), np.float32)
    vectors[cloud.valid] = features(cloud, SegmentationConfig())
    used = cloud.valid & (labels > 0)
    band = max(2, round(_BAND_SHARE * labels.shape[1]))
    kernel = np.ones((2 * band + 1, 2 * band + 1), np.uint8)
    total, weight = 0.0, 0
    for value in np.unique(labels[used]):
        inside = used & (labels == value)
        around = cv2.dilate(inside.astype(np.uint8), kernel).astype(bool) & used & ~inside
        if not around.any():
            continue
        own, other = vectors[inside], vectors[around]
        center = own.mean(axis=0, dtype=np.float64)
        contrast = (center - other.mean(axis=0, dtype=np.float64)).reshape(2, 3)
        dispersion = np.mean((own - center) ** 2, axis=0).reshape(2, 3)
        quality = np.linalg.norm(contrast, axis=1) - np.sqrt(dispersion.sum(axis=1))
        total += float(quality.mean()) * len(own)
        weight += len(own)
    return total / weight if weight else float("-inf")


def best_lambda(
    cloud: PointMap, config: SegmentationConfig, *, clusters: int, seed: int
) -> tuple[float, NDArray[np.uint16]]:
    """Choose, of `LAMBDAS`, the first whose flat clustering has the best unsupervised quality.

    Parameters
    ----------
    cloud : PointMap
        The frame.
    config : SegmentationConfig
        Settings of the clustering; its lambda is replaced.
    clusters : int
        Number of segments.
    seed : int
        Seed of the random numbers of each candidate.

    Returns
    -------
    lambda_ : float
        The chosen weight of geometry.
    labels : (H, W) uint16
        The clustering with this weight.
    """
    tried = []
    for candidate in LAMBDAS:
        weighted = replace(config, geometry_weight=candidate)
        labels = flat_clusters(cloud, weighted, clusters=clusters, rng=np.random.default_rng(seed))
        tried.append((unsupervised_quality(labels, cloud), candidate, labels))
    _, chosen, labels = max(tried, key=itemgetter(0))
    return chosen, labels
