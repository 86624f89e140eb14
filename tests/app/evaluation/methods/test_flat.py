"""Flat spectral clustering and the unsupervised choice of lambda."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from nurbseg.app.evaluation.methods.flat import (
    best_lambda,
    flat_clusters,
    spectral_embedding,
    unsupervised_quality,
)
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.scoring.scores import rand_index

COLUMNS = np.mgrid[:48, :64][1]
HALVES = (1 + (COLUMNS >= 32)).astype(np.uint16)


def wall(color: np.ndarray, step_m: float = 0.0) -> PointMap:
    """A wall of that color whose right half is nearer by a step."""
    rows, columns = np.mgrid[:48, :64]
    depth_m = np.where(columns >= 32, 1.5 - step_m, 1.5)
    points = np.dstack([(columns - 32) * depth_m / 60, (rows - 24) * depth_m / 60, depth_m])
    return PointMap(points.astype(np.float32), color.astype(np.uint8), np.ones(depth_m.shape, np.bool_))


def two_tone() -> np.ndarray:
    return np.where(COLUMNS[:, :, None] >= 32, (200, 30, 30), (30, 30, 200))


def test_with_every_point_in_the_sample_the_embedding_is_that_of_the_dense_matrix() -> None:
    rng = np.random.default_rng(1)
    vectors = np.concatenate([rng.normal(center, 0.4, (20, 3)) for center in (0.0, 2.0, 4.0)])
    W = np.exp(-cdist(vectors, vectors, "sqeuclidean") / 2.0)
    degrees = W.sum(axis=1)
    _, leading = np.linalg.eigh(W / np.sqrt(np.outer(degrees, degrees)))
    expected = leading[:, -3:]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    found = spectral_embedding(vectors.astype(np.float32), dimensions=3, samples=60, rng=rng)
    # Eigenvectors have no sign: what is fixed are the angles between points.
    np.testing.assert_allclose(found @ found.T, expected @ expected.T, atol=1e-5)


@pytest.mark.parametrize(("color", "step_m"), [(two_tone(), 0.0), (np.full((48, 64, 3), 90), 0.6)])
def test_halves_that_differ_in_color_or_in_depth_are_two_clusters(color: np.ndarray, step_m: float) -> None:
    cloud = wall(color, step_m)
    labels = flat_clusters(cloud, SegmentationConfig(), clusters=2, rng=np.random.default_rng(0))
    assert rand_index(labels, HALVES) > 0.95


def test_the_true_halves_have_more_quality_than_halves_elsewhere() -> None:
    cloud = wall(two_tone())
    elsewhere = (1 + (COLUMNS >= 16)).astype(np.uint16)
    assert unsupervised_quality(HALVES, cloud) > unsupervised_quality(elsewhere, cloud) + 0.5


def test_one_segment_has_the_least_quality() -> None:
    assert unsupervised_quality(np.ones((48, 64), np.uint16), wall(two_tone())) == float("-inf")


def test_the_chosen_lambda_is_the_one_whose_clusters_have_the_most_quality() -> None:
    rng = np.random.default_rng(4)
    cloud = wall(rng.integers(0, 256, (48, 64, 3)), step_m=0.5)
    config, candidates = SegmentationConfig(), (0.25, 1.0, 4.0)
    chosen, labels = best_lambda(cloud, config, clusters=2, seed=3, candidates=candidates)
    quality = {
        each: unsupervised_quality(
            flat_clusters(
                cloud, replace(config, geometry_weight=each), clusters=2, rng=np.random.default_rng(3)
            ),
            cloud,
        )
        for each in candidates
    }
    assert chosen == max(candidates, key=lambda each: quality[each])
    assert unsupervised_quality(labels, cloud) == quality[chosen]
    assert len(set(quality.values())) > 1


def test_without_candidates_there_is_nothing_to_choose() -> None:
    with pytest.raises(ValueError, match="at least one value of lambda"):
        best_lambda(wall(two_tone()), SegmentationConfig(), clusters=2, seed=0, candidates=())
