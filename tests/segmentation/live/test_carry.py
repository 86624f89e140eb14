"""The tree of the frame before, carried into a frame: its leaves, their parts, and what is new or gone."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plates import CONFIG, SHAPE, WALL_PER_M, Box, cloud_of, inside_of, plates

from nurbseg.common.settings import updated
from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.vocabulary import Division, StopReason

#: What is carried alone, without cuts or protrusions. T_p is 25 pixels of the grid, every second pixel.
ON_GRID = updated(CONFIG, depth_max=0, extended={"refine_borders": False, "protrusion_min": 0.0})
BOX: Box = (60, 40, 20, 20)
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)


def wall(change_per_m: NDArray[np.float64], thing_per_m: float = 1.2, frame: int = 1) -> PointMap:
    """The wall with a box before it, and a change of inverse depth of all of it."""
    inverse_depth = np.full(SHAPE, WALL_PER_M)
    inverse_depth[inside_of(BOX)] = thing_per_m
    return cloud_of(inverse_depth + change_per_m, plates(thing=BOX).color.astype(np.float64), frame)


@pytest.mark.parametrize("toward", [0.0, 0.02, -0.02])
@pytest.mark.parametrize("turned", [0.0, 2e-4, -1e-4])
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


@pytest.mark.parametrize(("rows", "reset"), [(8, ""), (12, "new scene")])
def test_a_scene_is_another_one_where_surfaces_do_not_explain_enough(rows: int, reset: str) -> None:
    live = LiveTree(CONFIG)
    live.segment(plates(frame=0))
    # 6.7 or 10 % of the rows.
    inverse_depth = np.where(rows > ROWS, 1.2, WALL_PER_M)
    live.segment(cloud_of(inverse_depth, np.full((*SHAPE, 3), 120.0), 5))
    assert live.report.reset == reset
    assert live.report.unexplained == pytest.approx(rows / 120, abs=0.02)


@pytest.mark.parametrize(("size", "leaves"), [((12, 2), 1), ((14, 2), 2)])
def test_a_leaf_below_a_quarter_of_the_least_has_vanished(size: tuple[int, int], leaves: int) -> None:
    live = LiveTree(ON_GRID)
    first = live.segment(plates(thing=BOX))
    assert len(first.leaves()) == 2
    # 6 or 7 grid pixels are left of the box.
    tree = live.segment(plates(thing=(60, 40, *size), frame=1))
    assert (live.report.reset, live.report.appeared) == ("", 0)
    assert len(tree.leaves()) == leaves
    if leaves == 2:
        (box,) = (leaf for leaf in tree.leaves() if leaf.fit.pixels.size < 100)
        assert np.array_equal(np.sort(box.pixels), np.flatnonzero(tree.labels() == tree.labels()[40, 60]))
        assert box.fit.pixels.size == 7
    else:
        assert (tree.root.name, tree.root.cuts_above) == ("", 0)


@pytest.mark.parametrize("height", [8, 10])
def test_what_nothing_explains_appears_beside_what_is_around_it_from_the_least_size_on(height: int) -> None:
    live = LiveTree(ON_GRID)
    live.segment(plates(frame=0))
    # 20 or 25 grid pixels.
    tree = live.segment(plates(thing=(60, 40, 10, height), frame=1), frame=1)
    assert live.report.reset == ""
    assert live.report.appeared == (height == 10)
    assert [leaf.fit.pixels.size for leaf in tree.leaves()] == ([4775, 25] if height == 10 else [4800])
    if height == 10:
        assert (tree.root.division, tree.root.judged) == (Division.APPEARED, None)
        assert tree.root.fit.surface is None
        assert [each.cuts_above for each in tree.segments] == [0, 0, 0]


def test_what_a_bar_in_front_cuts_in_two_is_one_again_without_it() -> None:
    live = LiveTree(updated(CONFIG, extended={"protrusion_min": 0.0}))
    live.segment(plates(frame=0))
    for frame in range(1, 10):
        tree = live.segment(plates(frame=frame, thing=(70, 0, 8, 120)))
        assert live.report.reset == ""
        labels = tree.labels()
        left, bar, right = (int(np.bincount(each.ravel()).argmax()) for each in np.split(labels, (70, 78), 1))
        assert len({left, bar, right}) == 3
    for frame in range(10, 14):
        tree = live.segment(plates(frame=frame))
        assert live.report.reset == ""
    assert len(tree.segments) == 1
    assert tree.root.stop is StopReason.NOISE
