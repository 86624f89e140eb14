"""The tree of the frame before, carried into a frame: its leaves, their parts, and what is new or gone."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plates import CONFIG, SHAPE, WALL_PER_M, Box, cloud_of, inside_of, plates
from scipy import ndimage
from sound_tree import assert_sound

from nurbseg.common.settings import updated
from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.vocabulary import StopReason

#: What is carried alone, without cuts or protrusions.
ON_GRID = updated(CONFIG, depth_max=0, extended={"refine_borders": False, "protrusion_min": 0.0})
BOX: Box = (60, 40, 20, 20)
POLE: Box = (72, 0, 10, SHAPE[0])
#: Pixels below which what something in front cuts off stays with a neighbor.
CUT_OFF = 400
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)


def wall(change_per_m: NDArray[np.float64], frame: int = 1) -> PointMap:
    """The wall with a box before it, and a change of inverse depth of all of it."""
    inverse_depth = np.full(SHAPE, WALL_PER_M)
    inverse_depth[inside_of(BOX)] = 1.2
    return cloud_of(inverse_depth + change_per_m, plates(thing=BOX).color.astype(np.float64), frame)


@pytest.mark.parametrize(("toward", "turned"), [(0.0, 0.0), (0.02, 2e-4), (-0.02, -1e-4), (0.0, 2e-4)])
def test_labels_stay_where_surfaces_move_as_the_camera_turns_or_comes_nearer(
    toward: float, turned: float
) -> None:
    live = LiveTree(ON_GRID)
    first = live.segment(wall(np.zeros(SHAPE)))
    tree = live.segment(wall(toward + turned * (COLUMNS - 0.5 * ROWS)))
    assert live.report.reset == ""
    assert live.report.unexplained < 0.01
    assert np.array_equal(tree.labels(), first.labels())
    for leaf in tree.leaves():
        # Fitted in this frame.
        assert leaf.measured is None
        assert leaf.fit.rms_per_m < 1.2 * CONFIG.extended.inverse_depth_noise


def assert_connected(tree: SegmentationTree) -> None:
    """Hold that leaves are connected, but for what is too small for a leaf of its own."""
    labels = tree.labels("surfaces")
    for label in range(1, len(tree.leaves()) + 1):
        parts = ndimage.label(labels == label, np.ones((3, 3)))[0]
        assert np.sort(np.bincount(parts.ravel())[1:])[:-1].max(initial=0) < CUT_OFF


def test_what_a_pole_cuts_apart_becomes_two_leaves_and_one_again() -> None:
    live = LiveTree(CONFIG)
    for frame in range(20):
        cloud = plates(frame=frame, thing=POLE if 5 <= frame < 12 else None)
        tree = live.segment(cloud)
        assert (live.report.reset == "") == (frame > 0)
        assert_sound(tree, cloud.valid)
        assert_connected(tree)
        labels = tree.labels("surfaces")
        if 5 <= frame < 12:
            assert len({*labels[60, [30, 77, 130]].tolist()}) == 3
        elif frame < 5 or frame > 14:
            assert len(tree.segments) == 1
    assert tree.root.stop is StopReason.NOISE


@pytest.mark.parametrize("seed", range(3))
def test_leaves_are_connected_and_tile_the_frame_as_things_come_go_and_hide_depth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    live, left, resets = LiveTree(CONFIG), 5.0, 0
    for frame in range(16):
        left += rng.uniform(3, 7)
        cloud = plates((20, 20, 36, 34), frame=frame, thing=(int(left), 30, 12, SHAPE[1] - 100))
        points_m, hole = cloud.points_m.copy(), int(rng.integers(5, 90))
        points_m[hole : hole + 9, 100:150] = np.nan
        tree = live.segment(PointMap(points_m, cloud.color, cloud.colored))
        resets += bool(live.report.reset)
        assert_sound(tree, np.isfinite(points_m[..., 2]))
        assert_connected(tree)
    assert resets < 8
