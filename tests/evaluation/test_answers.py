"""Sharing work between settings changes no tree."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from nurbseg.common.settings import updated
from nurbseg.evaluation import answers
from nurbseg.evaluation.answers import SharedWork
from nurbseg.segmentation.config import Metric, SegmentationConfig, Stag15Config
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.stag15 import segment_stag15


@pytest.fixture(scope="module")
def cloud() -> PointMap:
    rng = np.random.default_rng(5)
    rows, columns = np.mgrid[:60, :80]
    depth_m = 1.5 + 0.004 * rows + rng.normal(0, 0.002, rows.shape)
    for left, near in ((8, 0.9), (34, 1.1), (58, 0.7)):
        inside = (columns >= left) & (columns < left + 16) & (rows > 15) & (rows < 45)
        depth_m[inside] = near + 0.001 * rows[inside]
    points = np.dstack([(columns - 40) * depth_m / 70, (rows - 30) * depth_m / 70, depth_m])
    color = rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)
    return PointMap(points.astype(np.float32), color, np.ones((60, 80), np.bool_))


def shared_tree(cloud: PointMap, config: SegmentationConfig, shared: SharedWork) -> SegmentationTree:
    return segment_stag15(cloud, config, cut=shared.cut, fit=shared.fit)


def facts(tree: SegmentationTree) -> list[tuple[object, ...]]:
    return [(segment.name, segment.pixels.tolist(), segment.ratio, segment.stop) for segment in tree.segments]


def test_trees_are_the_same_with_and_without_sharing(cloud: PointMap) -> None:
    shared = SharedWork()
    base = SegmentationConfig(method="stag15", samples=40, stag15=Stag15Config(segment_pixels_min=300))
    for metric in get_args(Metric):
        for ratio_max in (1.0, 0.8):
            config = replace(base, metric=metric, ratio_max=ratio_max, large_error_m=0.05)
            assert facts(shared_tree(cloud, config, shared)) == facts(segment_stag15(cloud, config))


def test_settings_that_change_the_cut_do_not_share_it(cloud: PointMap) -> None:
    shared = SharedWork()
    base = SegmentationConfig(method="stag15", samples=40, stag15=Stag15Config(segment_pixels_min=300))
    shared_tree(cloud, base, shared)
    for change in (
        {"samples": 60},
        {"geometry_weight": 3.0},
        {"seed": 4},
        {"stag15": {"control_points": "fixed"}},
    ):
        config = updated(base, **change)
        assert facts(shared_tree(cloud, config, shared)) == facts(segment_stag15(cloud, config))


def test_cuts_and_fits_are_made_once(cloud: PointMap, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    for name in ("cut_in_two", "fit_segment"):
        step = getattr(answers, name)
        monkeypatch.setattr(
            answers, name, lambda *given, name=name, step=step: made.append(name) or step(*given)
        )
    shared = SharedWork()
    base = SegmentationConfig(method="stag15", samples=40, stag15=Stag15Config(segment_pixels_min=300))
    tree = shared_tree(cloud, base, shared)
    kept = sum(not segment.is_leaf for segment in tree.segments)
    tried = sum(segment.trial is not None for segment in tree.segments)
    assert made.count("fit_segment") == 1 + 2 * tried
    assert made.count("cut_in_two") >= tried > kept > 0
    before = list(made)
    shared_tree(cloud, replace(base, metric="mae", ratio_max=0.9, splits_max=kept - 1), shared)
    assert made == before
