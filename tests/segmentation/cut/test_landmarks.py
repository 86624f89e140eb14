"""Samples compared with the dense matrix of their affinities."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.linalg.lapack import dpstrf

from nurbseg.segmentation.cut.affinity import choose_landmarks


def test_the_inverse_factor_makes_affinities_of_what_is_kept_orthonormal():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(60, 5)).astype(np.float32)
    points[40:] = points[rng.integers(0, 40, 20)] + 1e-4 * rng.normal(size=(20, 5)).astype(np.float32)
    chosen, inverse = choose_landmarks(points, 0.7, 60)
    assert len(set(chosen.tolist())) == chosen.size <= 40
    x = points.astype(float)
    A = np.exp(-np.square(x[:, np.newaxis] - x).sum(axis=2) / (2 * 0.7**2))
    kept = A[np.ix_(chosen, chosen)]
    assert_allclose(inverse @ kept @ inverse.T, np.eye(chosen.size), atol=1e-10)
    assert (np.triu(inverse, 1) == 0).all()
    # What is left out is explained.
    explained = A[:, chosen] @ inverse.T
    assert (1.0 - np.square(explained).sum(axis=1) <= 1e-4 + 1e-12).all()


def test_fewer_landmarks_are_the_first_pivots_of_a_cholesky_factorization():
    points = np.random.default_rng(1).normal(size=(50, 6)).astype(np.float32)
    x = points.astype(float)
    A = np.exp(-np.square(x[:, np.newaxis] - x).sum(axis=2) / (2 * 0.9**2))
    # The diagonal is 1 everywhere: LAPACK, like the code, begins with the first.
    factor, pivots, rank, _ = dpstrf(A, lower=1)
    assert rank == 50
    for most in (1, 12, 50):
        chosen, inverse = choose_landmarks(points, 0.9, most)
        assert chosen.tolist() == (pivots[:most] - 1).tolist()
        assert_allclose(inverse @ np.tril(factor)[:most, :most], np.eye(most), atol=1e-9)
