"""Flat spectral clustering and the unsupervised choice of lambda."""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt
from scipy.spatial.distance import cdist
from skimage.color import rgb2lab

from nurbseg.evaluation.methods import flat
from nurbseg.evaluation.methods.flat import (
    best_lambda,
    flat_clusters,
    spectral_embedding,
    unsupervised_quality,
)
from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.registration import PointMap

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
    assert Contingency.between(labels, HALVES).rand_index() > 0.95


def plain_quality(labels: np.ndarray, cloud: PointMap, band: int) -> float:
    """Contrast less dispersion of each segment by size, from the definitions of CIELab and of distance."""
    used = cloud.valid & (labels > 0)
    cues = []
    for values in (rgb2lab(cloud.color), cloud.points_m.astype(float)):
        cues.append(values / values[cloud.valid].std(axis=0).mean())
    sums = []
    for value in np.unique(labels[used]):
        inside = used & (labels == value)
        beside = distance_transform_cdt(~inside, "chessboard") <= band
        own, around = inside, beside & used & ~inside
        if around.any():
            differences = [
                np.linalg.norm(cue[own].mean(axis=0) - cue[around].mean(axis=0))
                - np.sqrt(cue[own].var(axis=0).sum())
                for cue in cues
            ]
            sums.append((inside.sum(), np.mean(differences)))
    counts, qualities = np.array(sums).T
    return float(np.average(qualities, weights=counts))


@pytest.mark.parametrize(("width", "band"), [(64, 2), (130, 3)])
def test_quality_is_contrast_less_dispersion(width: int, band: int) -> None:
    rng = np.random.default_rng(width)
    rows, columns = np.mgrid[:40, :width]
    depth_m = 1.2 + 0.3 * (columns // 20 % 3) + 0.02 * rng.random(rows.shape)
    depth_m[rng.random(rows.shape) < 0.1] = np.nan
    color = np.clip(60 * (rows // 14)[..., None] + 30 + rng.normal(0, 9, (*rows.shape, 3)), 0, 255)
    points = np.dstack([columns * depth_m / 60, rows * depth_m / 60, depth_m]).astype(np.float32)
    cloud = PointMap(points, color.astype(np.uint8), np.ones(rows.shape, np.bool_))
    labels = (3 * (rows // 14) + columns // 20 % 3 + 1).astype(np.uint16)
    labels[rng.random(rows.shape) < 0.1] = 0
    # One segment that has no surroundings.
    labels[10:30, 5:25] = 0
    labels[19:21, 14:16] = 60
    assert unsupervised_quality(labels, cloud) == pytest.approx(plain_quality(labels, cloud, band), abs=0.01)


def test_one_segment_has_the_least_quality() -> None:
    assert unsupervised_quality(np.ones((48, 64), np.uint16), wall(two_tone())) == float("-inf")


def test_the_chosen_lambda_is_the_first_whose_clusters_have_the_most_quality(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Scripted clusterings: the true halves twice, and halves elsewhere before, between and after them."""
    elsewhere = (1 + (COLUMNS >= 16)).astype(np.uint16)
    scripted = {0.25: elsewhere, 0.5: HALVES, 1.0: elsewhere, 2.0: HALVES.copy(), 4.0: elsewhere}
    asked = []

    def clusters_of(
        cloud: PointMap, config: SegmentationConfig, *, clusters: int, rng: np.random.Generator
    ) -> np.ndarray:
        asked.append((config.geometry_weight, config.samples, clusters, int(rng.integers(1 << 40))))
        return scripted[config.geometry_weight]

    monkeypatch.setattr(flat, "flat_clusters", clusters_of)
    monkeypatch.setattr(flat, "LAMBDAS", tuple(scripted))
    config = SegmentationConfig(samples=77)
    chosen, labels = best_lambda(wall(two_tone()), config, clusters=2, seed=3)
    assert chosen == 0.5
    assert labels is HALVES
    # Each candidate starts from the same random numbers.
    first = int(np.random.default_rng(3).integers(1 << 40))
    assert asked == [(each, 77, 2, first) for each in scripted]
