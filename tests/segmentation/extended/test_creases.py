"""Planes that meet in a crease are surfaces of their own, alone and live; what bends smoothly is one."""

import numpy as np
import pytest
from corner import corner, fold
from numpy.typing import NDArray

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.vocabulary import Division, StopReason

CONFIG = SegmentationConfig()
OFF = updated(CONFIG, extended={"split_creases": False})


def overlap(tree: SegmentationTree, side: NDArray[np.bool_]) -> float:
    """Return by how much the best surface and one side of a crease overlap."""
    labels = tree.labels("surfaces")
    return max(
        ((labels == label) & side).sum() / ((labels == label) | side).sum()
        for label in range(1, labels.max() + 1)
    )


@pytest.mark.parametrize("frame", range(3))
def test_a_floor_and_a_wall_are_two_surfaces_and_two_objects(frame: int) -> None:
    cloud, is_wall = corner(frame)
    assert len(segment(cloud, OFF).leaves()) == 1
    tree = segment(cloud, CONFIG)
    assert len(tree.leaves()) == len(tree.objects) == 2
    assert overlap(tree, is_wall) > 0.97
    assert overlap(tree, ~is_wall) > 0.97
    assert tree.root.division is Division.CREASE
    trial = tree.root.trial
    assert trial is not None
    assert trial.kept
    assert 0.7 < trial.ratio < 1.0
    assert [leaf.stop for leaf in tree.leaves()] == [StopReason.NOISE] * 2


@pytest.mark.parametrize("degrees", [0, 10, 15, 25, 90])
def test_planes_meet_in_a_crease_from_20_degrees_on(degrees: int) -> None:
    cloud, is_right = fold(degrees)
    tree = segment(cloud, CONFIG)
    assert len(tree.leaves()) == (2 if degrees >= 20 else 1)
    if degrees >= 20:
        assert overlap(tree, is_right) > 0.97


@pytest.mark.parametrize("frame", range(2))
@pytest.mark.parametrize("radius_m", [0.5, 0.8, 1.1])
def test_what_bends_smoothly_is_one_surface(radius_m: float, frame: int) -> None:
    assert len(segment(corner(frame, radius_m)[0], CONFIG).leaves()) == 1


def test_a_crease_is_a_split_which_the_limits_count() -> None:
    cloud, _ = fold(90)
    assert [leaf.cuts_above for leaf in segment(cloud, CONFIG).leaves()] == [1, 1]
    for name in ("splits_max", "depth_max"):
        assert len(segment(cloud, updated(CONFIG, **{name: 0})).leaves()) == 1


def test_only_large_leaves_are_looked_at() -> None:
    cloud, _ = fold(90)
    columns = np.abs(np.arange(cloud.valid.shape[1]) - 159.5)
    for share, division in ((0.08, Division.CREASE), (0.05, None)):
        points_m = cloud.points_m.copy()
        points_m[:, columns >= share * 160] = np.nan
        assert segment(PointMap(points_m, cloud.color, cloud.colored), CONFIG).root.division is division


def test_a_crease_is_found_in_live_frames_and_given_back() -> None:
    live = LiveTree(CONFIG)
    for frame in range(20):
        degrees = min(3.0 * frame, 30.0)
        cloud, is_right = fold(degrees, frame)
        tree = live.segment(cloud)
        assert live.report.reset == ("first frame" if frame == 0 else "")
    assert overlap(tree, is_right) > 0.97
    assert tree.root.division is Division.CREASE
    found_in = tree.root.judged
    assert found_in is not None
    # It is 20 degrees in frame 7.
    assert 7 <= found_in <= 10
    # A little less than the least angle does not end it.
    for frame in range(20, 25):
        tree = live.segment(fold(17.0, frame)[0])
        assert len(tree.leaves()) == 2
    for frame in range(25, 30):
        tree = live.segment(fold(max(17.0 - 4.0 * (frame - 24), 0.0), frame)[0])
    assert (len(tree.leaves()), tree.root.division) == (1, None)
