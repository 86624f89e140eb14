"""The rivals run on a real cloud and give labels of its shape."""

from pathlib import Path

import numpy as np
import pytest

from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.methods.methods import METHODS, check_method
from nurbseg.evaluation.scoring.frame import score_frame
from nurbseg.segmentation.points.registration import register


@pytest.mark.parametrize("name", sorted(METHODS))
@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning", "ignore:.*:FutureWarning")
def test_a_rival_labels_every_point_the_same_for_the_same_seed(name: str, frames: Path) -> None:
    with open_source(str(frames)) as source:
        cloud = register(source.read())
    first, second = (METHODS[name](cloud, np.random.default_rng(3)) for _ in range(2))
    assert first.shape == cloud.valid.shape
    np.testing.assert_array_equal(first, second)
    assert len(np.unique(first[cloud.valid])) >= 1


def test_leaving_out_pixels_does_not_raise_a_score() -> None:
    truth = np.repeat(np.array([[1, 1, 2, 2]]), 4, axis=0)
    valid = np.ones_like(truth, dtype=bool)
    half = np.repeat(np.array([[1, 1, 0, 0]]), 4, axis=0)
    nothing_known = np.repeat(np.array([[1, 0, 0, 0]]), 4, axis=0)
    assert score_frame(half, truth, valid).gtrc == 1.0
    assert score_frame(nothing_known, truth, valid).gtrc < 0.9


def test_pixels_without_depth_count_in_neither_map() -> None:
    truth = np.repeat(np.array([[1, 1, 2, 2]]), 4, axis=0)
    labels = np.repeat(np.array([[1, 2, 2, 2]]), 4, axis=0)
    valid = np.repeat(np.array([[True, False, True, True]]), 4, axis=0)
    scores = score_frame(labels, truth, valid)
    assert (scores.ri, scores.gtrc, scores.voi, scores.obj) == (1.0, 1.0, 0.0, 1.0)


def test_an_unknown_method_lists_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"stag15.*fh04.*'magic'"):
        check_method("magic")
