"""What is remembered from frame to frame: nothing is tried again without a reason, nor kept without one."""

import pytest
from plates import CONFIG, PLATE_PER_M, PLATES, Box, plates, rising

from nurbseg.common.settings import updated
from nurbseg.segmentation.live.tree import UNLIMITED, LiveTree
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.vocabulary import StopReason

#: Two parts of a wall with plates beside a bar; T rejects every cut of either.
HALVES = updated(CONFIG, ratio_max=0.5, extended={"protrusion_min": 0.0})
BAR: Box = (72, 0, 16, 120)
STILL = 5


def still(live: LiveTree) -> SegmentationTree:
    """Segment frames in which nothing changes but noise; hold that nothing is tried again."""
    first = live.segment(rising(20, 0, BAR), UNLIMITED, frame=0)
    assert live.report.trials == 2
    assert [leaf.stop for leaf in first.leaves()].count(StopReason.CRITERION) == 2
    for frame in range(1, STILL):
        tree = live.segment(rising(20, frame, BAR), UNLIMITED, frame=frame)
        assert live.report.trials == 0
        for leaf, before in zip(tree.leaves(), first.leaves(), strict=True):
            assert (leaf.stop, leaf.trial) == (before.stop, before.trial)
            # The trial is that of the first frame, and says so.
            assert leaf.judged == (0 if leaf.stop is StopReason.CRITERION else None)
    return tree


@pytest.mark.parametrize("nearer", [1.05, 1.2])
def test_a_rejected_cut_is_tried_again_where_the_surface_explains_clearly_less(nearer: float) -> None:
    live = LiveTree(HALVES)
    still(live)
    changed = plates(*PLATES, frame=7, thing=BAR, nearer_per_m=4 * (nearer * PLATE_PER_M,))
    tree = live.segment(changed, UNLIMITED, frame=STILL)
    assert live.report.reset == ""
    assert live.report.trials == (2 if nearer == 1.2 else 0)
    if nearer == 1.2:
        assert 0 not in {leaf.judged for leaf in tree.leaves()}


@pytest.mark.parametrize("width", [20, 34])
def test_a_rejected_cut_is_tried_again_where_the_leaf_has_another_size(width: int) -> None:
    live = LiveTree(HALVES)
    still(live)
    # The bar covers a part of the right half: 6 or 25 percent.
    tree = live.segment(rising(20, 7, (72, 0, width, 120)), UNLIMITED, frame=STILL)
    assert live.report.reset == ""
    assert live.report.trials == (width == 34)
    assert [leaf.judged for leaf in tree.leaves()].count(0) == (1 if width == 34 else 2)
