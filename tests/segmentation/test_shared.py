"""Sharing work between settings changes no tree."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from nurbseg.drivers.settings import updated
from nurbseg.segmentation.config import Metric, SegmentationConfig, Stag15Config
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.shared import SharedWork
from nurbseg.segmentation.stag15 import SegmentationTree, segment


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


def facts(tree: SegmentationTree) -> list[tuple[object, ...]]:
    return [(each.name, each.pixels.tolist(), each.ratio, each.stop) for each in tree.segments]


def test_trees_are_the_same_with_and_without_sharing(cloud: PointMap) -> None:
    shared = SharedWork()
    base = SegmentationConfig(method="stag15", samples=40, stag15=Stag15Config(segment_pixels_min=300))
    for metric in get_args(Metric):
        for ratio_max in (1.0, 0.8):
            config = replace(base, metric=metric, ratio_max=ratio_max, large_error_m=0.05)
            assert facts(segment(cloud, config, shared)) == facts(segment(cloud, config))


def test_settings_that_change_the_cut_do_not_share_it(cloud: PointMap) -> None:
    shared = SharedWork()
    base = SegmentationConfig(method="stag15", samples=40, stag15=Stag15Config(segment_pixels_min=300))
    segment(cloud, base, shared)
    for change in (
        {"samples": 60},
        {"geometry_weight": 3.0},
        {"seed": 4},
        {"stag15": {"control_points": "fixed"}},
    ):
        config = updated(base, **change)
        assert facts(segment(cloud, config, shared)) == facts(segment(cloud, config))


def test_what_is_kept_is_made_once() -> None:
    made: list[int] = []
    shared = SharedWork()
    for ratio_max in (1.0, 0.9):
        config = SegmentationConfig(ratio_max=ratio_max)
        assert shared.once(config, "grid", lambda: made.append(1) or "made") == "made"
    assert made == [1]
