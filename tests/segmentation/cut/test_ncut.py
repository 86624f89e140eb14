"""The cut compared with the exact generalized eigenproblem and against trying every partition."""

from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.linalg import eigh

from nurbseg.segmentation.cut.affinity import affinity
from nurbseg.segmentation.cut.ncut import normalized_cut, normalized_cuts


def dense_affinity(vectors: NDArray[np.float32], scale: float = 1.0) -> NDArray[np.float64]:
    x = vectors.astype(float)
    return np.exp(-((x[:, None] - x[None]) ** 2).sum(axis=2) / (2 * scale**2))


def dense_indicator(vectors: NDArray[np.float32], scale: float = 1.0) -> NDArray[np.float64]:
    """The second generalized eigenvector of (D - W) y = lambda D y (SM00)."""
    W = dense_affinity(vectors, scale)
    D = np.diag(W.sum(axis=1))
    return eigh(D - W, D)[1][:, 1]


def ncut_of(W: NDArray[np.float64], side: NDArray[np.bool_]) -> float:
    between = W[side][:, ~side].sum()
    return float(between / W[side].sum() + between / W[~side].sum())


def two_clusters(n: int, seed: int, gap: float = 2.5) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    vectors = rng.normal(0, 0.6, (n, 6))
    vectors[: n // 3, 0] += gap
    return vectors.astype(np.float32)


def same_partition(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> bool:
    return bool((a == b).all() or (a == ~b).all())


@pytest.mark.parametrize("seed", range(5))
def test_a_sample_of_a_third_finds_the_partition_of_the_exact_eigenproblem(seed):
    vectors = two_clusters(300, seed, gap=4.0)
    cut = normalized_cut(vectors, samples=100, rng=np.random.default_rng(seed))
    exact = dense_indicator(vectors) > 0
    agreeing = (cut.side == exact).mean()
    assert max(agreeing, 1 - agreeing) >= 0.99


@pytest.mark.parametrize("seed", range(6))
def test_the_least_ncut_of_all_partitions_is_found_for_ten_points(seed):
    vectors = two_clusters(10, seed, gap=4.0)
    W = dense_affinity(vectors)
    partitions = (np.array((False, *rest)) for rest in product([False, True], repeat=9))
    best = min((p for p in partitions if p.any()), key=lambda p: ncut_of(W, p))
    for splitting_point in ("zero", "kmeans", "ncut"):
        cut = normalized_cut(
            vectors, samples=10, rng=np.random.default_rng(0), splitting_point=splitting_point
        )
        assert same_partition(cut.side, best), splitting_point


def test_two_means_on_the_eigenvector_is_the_best_threshold():
    vectors = two_clusters(60, 1, gap=2.0)
    cut = normalized_cut(vectors, samples=60, rng=np.random.default_rng(0), splitting_point="kmeans")
    values = np.sort(dense_indicator(vectors))
    scatter = [values[:k].var() * k + values[k:].var() * (60 - k) for k in range(1, 60)]
    best = 1 + int(np.argmin(scatter))
    assert cut.side.sum() in (best, 60 - best)


def test_affinities_are_gaussian():
    rng = np.random.default_rng(0)
    points, landmarks = rng.normal(0.0, 0.3, (50, 6)), rng.normal(0.0, 0.3, (7, 6))
    expected = np.exp(-((points[:, None] - landmarks[None]) ** 2).sum(axis=2) / (2 * 0.7**2))
    points, landmarks = points.astype(np.float32), landmarks.astype(np.float32)
    for rows, columns in ((50, 7), (0, 7), (50, 0)):
        found = affinity(points, landmarks[:columns], 0.7, np.arange(rows))
        assert_allclose(found, expected[:rows, :columns], atol=1e-5)


def test_classifying_the_points_that_were_cut_gives_their_sides():
    vectors = two_clusters(5000, 2)
    cut = normalized_cut(vectors, samples=60, rng=np.random.default_rng(0), points=1000)
    assert (cut.classify(vectors) == cut.side).all()
    assert 0.05 < cut.side.mean() < 0.95
    assert cut.classify(np.zeros((0, 6), dtype=np.float32)).shape == (0,)


def test_affinities_that_fall_apart_are_cut_between_components():
    rng = np.random.default_rng(0)
    vectors = rng.normal(0, 0.3, (400, 6)).astype(np.float32)
    vectors[250:] += 40.0
    cut = normalized_cut(vectors, samples=50, rng=rng)
    assert same_partition(cut.side, np.arange(400) < 250)


@pytest.mark.parametrize("n", [0, 1])
def test_fewer_than_two_points_have_no_cut(n):
    cut = normalized_cut(np.zeros((n, 6), dtype=np.float32), samples=50, rng=np.random.default_rng(0))
    assert cut.side.shape == (n,)
    assert cut.reason == f"{n} points, 2 needed"


def test_equal_points_have_no_cut():
    cut = normalized_cut(np.ones((500, 6), dtype=np.float32), samples=50, rng=np.random.default_rng(0))
    assert not cut.side.any()
    assert cut.reason == "all points are equal"


def test_vectors_that_are_not_finite_are_refused():
    vectors = np.ones((10, 6), dtype=np.float32)
    vectors[3, 2] = np.nan
    with pytest.raises(ValueError, match="finite"):
        normalized_cut(vectors, samples=5, rng=np.random.default_rng(0))


def test_points_that_are_all_far_apart_have_cuts_or_a_reason():
    # Then the matrix is nearly the identity, and LAPACK finds fewer eigenvalues than it was asked for.
    rng = np.random.default_rng(0)
    vectors = (rng.normal(size=(200, 6)) * 20).astype(np.float32)
    for cut in normalized_cuts(vectors, count=3, samples=30, rng=rng, affinity_scale=0.7):
        assert cut.side.shape == (200,)
        assert cut.reason or (cut.side.any() and not cut.side.all())


@pytest.mark.parametrize("count", [1, 3])
def test_the_cuts_are_those_of_the_second_eigenvector_and_the_next(count):
    rng = np.random.default_rng(3)
    vectors = rng.normal(0, 0.5, (120, 4)).astype(np.float32)
    # Four things at distances of their own, so that no two eigenvalues are alike.
    for number, at in enumerate([(0, 0, 0, 0), (2.0, 0, 0, 0), (0, 2.6, 0, 0), (0, 0, 3.4, 0)]):
        vectors[30 * number : 30 * (number + 1)] += np.array(at, dtype=np.float32)
    W = dense_affinity(vectors)
    D = np.diag(W.sum(axis=1))
    exact = eigh(D - W, D)[1][:, 1 : 1 + count]
    cuts = list(normalized_cuts(vectors, count=count, samples=120, rng=np.random.default_rng(0)))
    assert len(cuts) == count
    drawn = np.random.default_rng(0).choice(120, size=120, replace=False)
    for cut, indicator in zip(cuts, exact.T, strict=True):
        clear = np.abs(indicator) > 2e-3 * np.abs(indicator).max()
        assert clear.sum() > 100
        assert same_partition(cut.side[clear], indicator[clear] > 0)
        # An eigenvector is known up to its sign: the first clear sample decides it, on any computer.
        assert cut.side[drawn[np.abs(indicator[drawn]) >= 0.5 * np.abs(indicator).max()][0]]
        # Continued to where the points are, the cut is the same.
        assert (cut.classify(vectors) == cut.side).all()


@pytest.mark.parametrize("points", [None, 200])
def test_the_least_ncut_is_that_of_the_best_of_so_many_thresholds(points):
    """Over thresholds at equal counts of points on the dense eigenvector, by the definition of Ncut."""
    rng = np.random.default_rng(2)
    vectors = np.concatenate([rng.normal(0, 0.7, (150, 3)), rng.normal(2.2, 0.4, (50, 3))]).astype(np.float32)
    W = dense_affinity(vectors, 0.7)
    order = np.argsort(dense_indicator(vectors, 0.7))
    costs = {}
    for edge in {(k * 200) // 48 for k in range(1, 48)}:
        side = np.zeros(200, dtype=bool)
        side[order[:edge]] = True
        costs[edge] = ncut_of(W, side)
    cut = normalized_cut(
        vectors, samples=200, rng=rng, affinity_scale=0.7, splitting_point="ncut", points=points
    )
    best = min(costs, key=lambda edge: costs[edge])
    assert cut.side.sum() in (best, 200 - best)
    assert ncut_of(W, cut.side) == pytest.approx(costs[best], rel=1e-3)
