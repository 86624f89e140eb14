"""Means and their intervals."""

import numpy as np
import pytest

from nurbseg.app.evaluation.results import bootstrap_mean


def test_the_interval_is_that_of_the_means_of_resampled_frames() -> None:
    values = np.random.default_rng(1).normal(0.8, 0.1, 60)
    found = bootstrap_mean(values, draws=20_000)
    rng = np.random.default_rng(2)
    means = [rng.choice(values, values.size).mean() for _ in range(20_000)]
    assert found.mean == pytest.approx(values.mean())
    assert found.low == pytest.approx(np.quantile(means, 0.025), abs=1e-3)
    assert found.high == pytest.approx(np.quantile(means, 0.975), abs=1e-3)


def test_one_frame_is_its_own_interval() -> None:
    found = bootstrap_mean(np.array([0.25, np.nan]))
    assert (found.mean, found.low, found.high, found.frames) == (0.25, 0.25, 0.25, 1)


def test_frames_without_a_value_are_left_out() -> None:
    found = bootstrap_mean(np.array([0.5, np.nan, 0.7]))
    assert found.frames == 2
    assert found.mean == pytest.approx(0.6)
    assert np.isnan(bootstrap_mean(np.array([np.nan])).mean)
