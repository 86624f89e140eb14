"""What is remembered from frame to frame: that nothing is tried again without a reason, and what is one."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from plates import CONFIG, plates, rising

from nurbseg.common.settings import updated
from nurbseg.segmentation.extended import memory as memory_module
from nurbseg.segmentation.extended.grid_features import GridFeatures, grid_features
from nurbseg.segmentation.extended.memory import LeafMemory, TreeMemory, leaf_memory
from nurbseg.segmentation.extended.parts import fit_segment
from nurbseg.segmentation.live.tree import UNLIMITED, LiveTree
from nurbseg.segmentation.segments import Node, Trial
from nurbseg.segmentation.vocabulary import Division, StopReason

CUTS = updated(CONFIG, extended={"protrusion_min": 0.0})
#: In front of all rows: the wall is in two parts.
BAR = (72, 0, 16, 120)


def test_what_is_remembered_of_trials_changes_no_label_of_a_still_scene() -> None:
    config = replace(CUTS, ratio_max=0.5)
    kept, forgetful = LiveTree(config), LiveTree(config)
    for frame in range(6):
        # The same noise in all frames: nothing changes.
        cloud = rising(20, 0, BAR)
        for leaf in forgetful._leaves:
            leaf.attempt = None
        one, other = (tree.segment(cloud, UNLIMITED) for tree in (kept, forgetful))
        assert np.array_equal(one.labels(), other.labels())
        assert [segment.stop for segment in one.segments] == [segment.stop for segment in other.segments]
        assert [leaf.stop for leaf in one.leaves()].count(StopReason.CRITERION) == 2
        if frame > 0:
            # What was found in the first frame is told, or found again.
            assert (kept.report.trials, forgetful.report.trials) == (0, 2)


@pytest.fixture
def features() -> GridFeatures:
    """A wall, with two plates that one surface explains badly."""
    return grid_features(plates((12, 14, 40, 36), (100, 16, 44, 40)), CUTS)


@pytest.fixture
def leaf(features: GridFeatures) -> Node:
    """All of the frame, with a memory."""
    node = fit_segment(features, np.flatnonzero(features.grid.valid), CUTS)
    node.memory = LeafMemory(0)
    assert node.stop is None
    return node


def tried(leaf: Node, frame: int) -> TreeMemory:
    """A memory of a rejected trial of a leaf in a frame, which is asked in the next one."""
    memory = TreeMemory(CUTS)
    memory.begin(leaf, frame)
    leaf.stop, leaf.trial = StopReason.CRITERION, Trial("mse", 1.0, 2, ((1.0, 1), (1.0, 1)), False)
    memory.note(leaf)
    leaf.stop = leaf.trial = leaf.judged = None
    memory.begin(leaf, frame + 1)
    return memory


def test_a_rejected_trial_is_told_as_long_as_nothing_changes(leaf: Node, features: GridFeatures) -> None:
    tried(leaf, 7).recall(leaf, features)
    assert leaf.stop is StopReason.CRITERION
    assert leaf.trial is not None
    assert leaf.judged == 7


@pytest.mark.parametrize("change", ["worse", "smaller", "old"])
def test_a_leaf_is_tried_again_when_it_has_changed(leaf: Node, features: GridFeatures, change: str) -> None:
    memory = tried(leaf, 7)
    if change == "worse":
        worse = {name: 2.0 * value for name, value in leaf.fit.values.items()}
        leaf.fit = replace(leaf.fit, values=worse)
    elif change == "smaller":
        leaf.grid_pixels = leaf.grid_pixels[: leaf.grid_pixels.size // 2]
    else:
        memory.begin(leaf, 7 + memory_module.TRIAL_FRAMES)
    memory.recall(leaf, features)
    assert (leaf.stop, leaf.trial) == (None, None)


@pytest.mark.parametrize(("share_of_floor", "is_tried"), [(0.09, False), (0.12, True)])
def test_noise_near_the_floor_is_no_reason_to_try_a_leaf_again(
    leaf: Node, features: GridFeatures, share_of_floor: float, is_tried: bool
) -> None:
    def measured(value: float) -> None:
        leaf.fit = replace(leaf.fit, values={**leaf.fit.values, CUTS.metric: value})

    floor = leaf.fit.floor
    measured(1.001 * floor)
    memory = tried(leaf, 7)
    # Its excess over the floor is many times what it was.
    measured((1.001 + share_of_floor) * floor)
    memory.recall(leaf, features)
    assert (leaf.stop is None) == is_tried


def test_a_reason_of_this_frame_goes_before_a_remembered_one(leaf: Node, features: GridFeatures) -> None:
    memory = tried(leaf, 7)
    leaf.cuts_above = CUTS.depth_max
    memory.recall(leaf, features)
    assert (leaf.stop, leaf.trial) == (StopReason.DEPTH, None)


def test_only_outcomes_of_trials_are_remembered(leaf: Node) -> None:
    memory = TreeMemory(CUTS)
    for stop in StopReason:
        leaf_memory(leaf).attempt = None
        leaf.stop = stop
        memory.note(leaf)
        is_outcome = stop in (StopReason.CRITERION, StopReason.CHILD_TOO_SMALL, StopReason.NO_CUT)
        assert (leaf_memory(leaf).attempt is not None) == is_outcome


def parts_of(leaf: Node, *columns: int) -> list[Node]:
    """The leaf's grid pixels up to each column, and those beyond the last."""
    at = leaf.grid_pixels % 80
    ends = [0, *columns, 80]
    return [
        Node(f"{n}", leaf.grid_pixels[(at >= first) & (at < end)], leaf.fit)
        for n, (first, end) in enumerate(pairwise(ends))
    ]


@pytest.mark.parametrize("column", [20, 60])
def test_the_largest_part_of_a_split_is_what_the_leaf_was(leaf: Node, column: int) -> None:
    memory = TreeMemory(CUTS)
    memory.begin(leaf, 9)
    before = leaf.memory

    def split(node: Node) -> None:
        one, other = parts_of(node, column)
        node.children, node.division = (one, other), Division.CUT

    memory.remembering(split)(leaf)
    sizes = [part.grid_pixels.size for part in leaf.children]
    (new,) = (part for part in leaf.children if part.grid_pixels.size < max(sizes))
    (same,) = (part for part in leaf.children if part is not new)
    assert same.memory is before
    assert leaf_memory(new).born == 9
    assert leaf.memory is None
    assert (memory.trials, memory.splits, memory.cut_pixels) == (1, 1, leaf.grid_pixels.size)


def test_leaves_are_compared_when_one_is_new_or_parts_of_one_meet_again(leaf: Node) -> None:
    old, other, new, cut_off = parts_of(leaf, 20, 40, 60)
    for node, born in ((old, 0), (other, 0), (new, 5)):
        node.memory = LeafMemory(born)
    cut_off.memory = LeafMemory(2, cut_from=leaf_memory(old))
    memory = TreeMemory(CUTS)

    def ask(frame: int) -> list[bool]:
        memory.begin(leaf, frame)
        return [memory.meet_newly(old, each) for each in (other, new, cut_off)]

    assert ask(5) == [False, True, True]
    assert ask(6) == [False, False, False]
    # They met long ago: they meet again.
    assert ask(500) == [False, False, True]


def test_a_leaf_is_looked_at_again_when_clearly_more_is_far_from_its_surface(leaf: Node) -> None:
    memory, least = TreeMemory(CUTS), 25.0
    assert memory.has_more_far(leaf, 100, least)
    assert not memory.has_more_far(leaf, 100, least)
    assert not memory.has_more_far(leaf, 130, least)
    # The fewest count, also those of a frame in which it was not looked at.
    assert not memory.has_more_far(leaf, 10, least)
    assert memory.has_more_far(leaf, 100, least)


def test_a_leaf_is_looked_at_for_creases_again_when_it_has_changed(leaf: Node) -> None:
    memory, size = TreeMemory(CUTS), leaf.grid_pixels.size
    assert memory.is_bent_anew(leaf, 0.01)
    assert not memory.is_bent_anew(leaf, 0.0119)
    assert memory.is_bent_anew(leaf, 0.0121)
    # Better than before is no reason, another size is one.
    assert not memory.is_bent_anew(leaf, 0.001)
    leaf.grid_pixels = leaf.grid_pixels[: round(0.86 * size)]
    assert not memory.is_bent_anew(leaf, 0.0121)
    leaf.grid_pixels = leaf.grid_pixels[: round(0.84 * size)]
    assert memory.is_bent_anew(leaf, 0.0121)
    assert leaf_memory(leaf).bent == (0.0121, round(0.84 * size))


def test_the_average_of_a_ratio_is_that_of_judging_in_every_frame(leaf: Node) -> None:
    config = replace(CUTS, ratio_max=0.8)
    every, seldom = TreeMemory(config), TreeMemory(config)
    one, other = (Node("", leaf.grid_pixels, leaf.fit) for _ in range(2))
    every.frame = seldom.frame = 3
    assert every.average_ratio(one, 0.4, 0.2) == pytest.approx(math.log(0.5))
    assert seldom.average_ratio(other, 0.4, 0.2) == pytest.approx(math.log(0.5))
    # After a change, four frames at the new ratio, of which the other judges only the last.
    for every.frame in range(4, 8):
        expected = every.average_ratio(one, 1.2, 0.2)
    seldom.frame = 7
    assert seldom.average_ratio(other, 1.2, 0.2) == pytest.approx(expected)
    assert math.log(0.5) < expected < math.log(1.5)
    one.division = Division.CUT
    every.frame = 19
    assert every.oldest(one) == 12


def test_a_node_without_the_memory_of_a_leaf_is_an_error(leaf: Node) -> None:
    leaf.memory = None
    with pytest.raises(TypeError, match="expected a leaf with a memory"):
        leaf_memory(leaf)
