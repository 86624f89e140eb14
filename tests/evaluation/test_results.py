"""Means and their intervals."""

import numpy as np
import pytest

from nurbseg.evaluation.results import StudyResults, bootstrap_mean
from nurbseg.evaluation.variants import Variant
from nurbseg.segmentation.config import SegmentationConfig


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


def test_the_best_have_the_greatest_mean_or_least_error_to_three_digits() -> None:
    variants = [
        Variant(f"{method} {samples}", method, SegmentationConfig(method="stag15", samples=samples))
        for method, samples in (("stag15", 50), ("stag15", 60), ("stag15", 70), ("fh04", 70))
    ]
    # Of two frames; the second has no obj.
    scores = {
        "gtrc": [(0.5, 0.7), (0.6, 0.6008), (0.8, 0.1), (0.2, 0.3)],
        "voi": [(2.0, 1.0), (1.0, 1.0), (3.0, 0.2), (1.0, 0.9999)],
        "obj": [(0.1, None), (0.3, None), (0.2, None), (None, None)],
    }
    frames = [
        {
            "key": f"{n}",
            "category": "boxes" if n else "bowls",
            "results": {
                variant.key: {score: values[k][n] for score, values in scores.items()}
                for k, variant in enumerate(variants)
            },
        }
        for n in range(2)
    ]
    found = StudyResults(tuple(variants), tuple(frames), ())
    assert found.categories() == ("bowls", "boxes")
    assert found.best("gtrc") == {"stag15 50", "stag15 60"}
    assert found.best("voi") == {"stag15 60", "fh04 70"}
    assert found.best("obj") == {"stag15 60"}
    assert found.best("obj", "boxes") == set()
    assert found.best("gtrc", "bowls") == {"stag15 70"}
    assert found.best("voi", "boxes") == {"stag15 70"}
    # Not rounded.
    assert [leader.name for leader in found.leaders()] == ["stag15 60", "fh04 70"]
    assert [frame["key"] for frame in found.worst_frames(variants[0])] == ["0", "1"]
    assert [frame["key"] for frame in found.worst_frames(variants[2])] == ["1", "0"]
