"""Means and their intervals."""

import numpy as np
import pytest
from scipy import stats

from nurbseg.app.evaluation.statistics import bootstrap_gain, bootstrap_mean


def test_the_interval_agrees_with_scipy_s_bootstrap() -> None:
    values = np.random.default_rng(1).normal(0.8, 0.1, 60)
    ours = bootstrap_mean(values, draws=20_000)
    theirs = stats.bootstrap(
        (values,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(2)
    ).confidence_interval
    assert ours.mean == pytest.approx(values.mean())
    assert ours.low == pytest.approx(theirs.low, abs=1e-3)
    assert ours.high == pytest.approx(theirs.high, abs=1e-3)


def test_frames_without_a_value_are_left_out() -> None:
    found = bootstrap_mean(np.array([0.5, np.nan, 0.7]))
    assert found.frames == 2
    assert found.mean == pytest.approx(0.6)
    assert np.isnan(bootstrap_mean(np.array([np.nan])).mean)


def test_a_gain_on_the_same_frames_is_surer_than_the_means() -> None:
    rng = np.random.default_rng(0)
    hard = rng.uniform(0, 1, 40)
    gain = bootstrap_gain(hard + 0.05, hard)
    assert gain.mean == pytest.approx(0.05)
    assert gain.low == pytest.approx(0.05)
