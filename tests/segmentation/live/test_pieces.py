"""Leaves are connected and tile the frame, whatever is in front of them; what was cut apart meets again."""

import cv2
import numpy as np
import pytest
from plates import CONFIG, SHAPE, Box, plates

from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.segments import SegmentationTree

#: T_p in pixels, and those below which what something in front cuts off stays with a neighbor.
LEAST, CUT_OFF = 100, 400
POLE: Box = (72, 0, 10, SHAPE[0])


def parts_of(mask: np.ndarray) -> list[int]:
    """Return the sizes of the connected parts of a mask, the largest first."""
    sizes = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)[2][1:, cv2.CC_STAT_AREA]
    return sorted(sizes.tolist(), reverse=True)


def assert_tiles(tree: SegmentationTree, valid: np.ndarray) -> None:
    """Hold that each pixel with depth has one leaf, and that leaves are connected and have a reason."""
    labels, leaves = tree.labels("surfaces"), tree.leaves()
    assert np.array_equal(labels > 0, valid)
    assert len({segment.name for segment in tree.segments}) == len(tree.segments)
    assert sum(leaf.pixels.size for leaf in leaves) == np.count_nonzero(valid)
    for number, leaf in enumerate(leaves, start=1):
        assert leaf.stop is not None
        assert np.array_equal(leaf.pixels, np.flatnonzero(labels == number))
        assert all(size < CUT_OFF for size in parts_of(labels == number)[1:])


def test_what_a_pole_cuts_apart_becomes_two_leaves_and_one_again() -> None:
    live = LiveTree(CONFIG)
    for frame in range(20):
        cloud = plates(frame=frame, thing=POLE if 5 <= frame < 12 else None)
        tree = live.segment(cloud)
        assert (live.report.reset == "") == (frame > 0)
        assert_tiles(tree, cloud.valid)
        labels = tree.labels("surfaces")
        left, pole, right = labels[60, 30], labels[60, 77], labels[60, 130]
        if 5 <= frame < 12:
            assert len({int(left), int(pole), int(right)}) == 3
        elif frame < 5 or frame > 14:
            assert left == pole == right
            assert len(tree.leaves()) == 1


@pytest.mark.parametrize("seed", range(3))
def test_leaves_are_connected_and_tile_the_frame_as_things_come_go_and_hide_depth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    live, left, resets = LiveTree(CONFIG), 5.0, 0
    for frame in range(16):
        left += rng.uniform(3, 7)
        cloud = plates((20, 20, 36, 34), frame=frame, thing=(int(left), 30, 12, SHAPE[1] - 100))
        hole = int(rng.integers(5, 90))
        cloud.points_m.setflags(write=True)
        cloud.points_m[hole : hole + 9, 100:150] = np.nan
        valid = np.isfinite(cloud.points_m[..., 2])
        tree = live.segment(type(cloud)(cloud.points_m, cloud.color, cloud.colored))
        resets += bool(live.report.reset)
        assert_tiles(tree, valid)
    assert resets < 8
