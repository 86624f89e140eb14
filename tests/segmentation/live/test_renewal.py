"""Which splits are judged again in a frame and by what, and the reasons that leaves are given."""

from dataclasses import replace

import numpy as np
import pytest
from designed_tree import BEFORE, CONFIG, FRAME, Band, DesignedTree, designed_tree
from exact_surface import metric, ratio

from nurbseg.segmentation.live.editor import UpdateReport
from nurbseg.segmentation.live.leaf import Attempt, LiveLeaf
from nurbseg.segmentation.live.renewal import renew_splits, set_stop_reasons
from nurbseg.segmentation.segments import Node, Trial
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.vocabulary import Division, StopReason


@pytest.fixture
def tree() -> DesignedTree:
    """A root of 4000 places, cut into parts of 1000 and 3000, and these cut again; the last two are flush."""
    return designed_tree(
        Band("00", 8, rows=50),
        Band("01", 12, 0.02, rows=50),
        Band("10", 30, rows=50),
        Band("11", 30, rows=50),
    )


def renewed(
    tree: DesignedTree, ages: dict[str, int], *, every: bool = False
) -> tuple[UpdateReport, set[str]]:
    """Return what was done, and the names of the splits that were rejected."""
    for name, age in ages.items():
        tree.nodes[name].age = age
    report = UpdateReport()
    rejected = renew_splits(
        tree.root, tree.leaves, tree.labels, tree.features, FRAME, CONFIG, report, every_surface=every
    )
    return report, {node.name for node in rejected}


def judged(tree: DesignedTree) -> set[str]:
    """Splits that were judged and kept, by what is written down of them."""
    found = set()
    for name in ("", "0", "1"):
        node = tree.nodes[name]
        assert node.trial is not None
        is_new = node.judged == FRAME
        assert is_new == (node.age == 0) == (node.trial.value != 9.0)
        if is_new:
            found.add(name)
    return found


@pytest.mark.parametrize(
    ("ages", "kept", "rejected"),
    [
        # The oldest first, while there is room for 4000 places: what is too large does not end it.
        ({"": 5, "0": 9, "1": 7}, {"0"}, {"1"}),
        ({"": 9, "0": 7, "1": 8}, {""}, set()),
        ({"": 8, "0": 9, "1": 7}, {"0"}, {"1"}),
        # After 60 frames there is room for any.
        ({"": 60, "0": 60, "1": 59}, {"", "0"}, set()),
        ({"": 61, "0": 70, "1": 60}, {"", "0"}, {"1"}),
    ],
)
def test_the_oldest_splits_are_judged_while_there_is_room(
    tree: DesignedTree, ages: dict[str, int], kept: set[str], rejected: set[str]
) -> None:
    report, found = renewed(tree, ages)
    assert report.judged == len(kept | rejected)
    assert judged(tree) == kept
    # The wall on both sides of the last cut is one plane: its ratio is no less than 1.
    assert found == rejected
    left = [tree.nodes[name].age for name in ("", "0", "1")]
    assert report.oldest == max(left) == max(0 if name in kept else age for name, age in ages.items())


def test_one_more_place_than_there_is_room_for_waits() -> None:
    tree = designed_tree(
        Band("00", 8, rows=50),
        Band("01", 12, 0.02, rows=50),
        Band("10", 20, rows=51),
        Band("11", 39, rows=51),
    )
    # 1000 and 3009 places.
    assert renewed(tree, {"": 1, "0": 9, "1": 7})[0].judged == 1
    assert judged(tree) == {"0"}


def test_a_split_is_judged_by_one_surface_for_all_and_those_of_the_leaves(tree: DesignedTree) -> None:
    # One of the leaves is out of sight, and is no part.
    gone = tree.leaves[0].node
    tree.labels[tree.labels == 1] = 0
    gone.grid_pixels = np.zeros(0, dtype=np.intp)
    renewed(tree, {"": 9, "0": 1, "1": 1})
    root = tree.root
    assert root.trial is not None
    shown = np.flatnonzero(tree.labels)
    assert np.array_equal(root.fit.pixels, (shown // 80 * 160 + shown % 80) * 2)
    assert (root.measured, root.judged) == (FRAME, FRAME)
    values = [
        (metric("mse", fit, tree.cloud, CONFIG), fit.pixels.size)
        for fit in (root.fit, *(leaf.node.fit for leaf in tree.leaves[1:]))
    ]
    # What noise leaves counts at least: of the parts it does.
    floors = [root.fit.floor, *(leaf.node.fit.floor for leaf in tree.leaves[1:])]
    whole, *parts = ((max(value, floor), n) for (value, n), floor in zip(values, floors, strict=True))
    assert [root.trial.points, *(n for _, n in root.trial.parts)] == [3600, 600, 1500, 1500]
    assert root.trial.ratio == pytest.approx(ratio("mse", whole, *parts), rel=1e-3)
    assert root.trial.ratio < 0.5
    assert root.trial.kept


def test_what_is_not_fitted_in_this_frame_has_no_surface(tree: DesignedTree) -> None:
    fits = {name: tree.nodes[name].fit for name in ("", "0", "1")}
    # The one was made in this frame, the other before.
    tree.nodes["1"].measured = FRAME
    renewed(tree, {"": 9, "0": 1, "1": 1})
    assert tree.nodes["1"].fit is fits["1"]
    before = tree.nodes["0"].fit
    assert (before.surface, before.residuals_m.size) == (None, 0)
    assert before.reason == f"measured in frame {BEFORE}"
    assert before.values == fits["0"].values
    assert np.array_equal(before.pixels, fits["0"].pixels)
    assert tree.nodes["0"].measured == BEFORE
    assert tree.root.fit.surface is not None


def test_every_split_gets_its_surface_on_request(tree: DesignedTree) -> None:
    assert renewed(tree, {"": 9, "0": 1, "1": 1}, every=True)[0].judged == 1
    assert judged(tree) == {""}
    for name, (first, last) in (("", (1, 4)), ("0", (1, 2)), ("1", (3, 4))):
        node = tree.nodes[name]
        assert node.measured == FRAME
        assert node.fit.surface is not None
        places = np.flatnonzero((tree.labels >= first) & (tree.labels <= last))
        assert np.array_equal(node.fit.pixels, (places // 80 * 160 + places % 80) * 2)


def test_what_no_cut_made_has_neither_surface_nor_trial_nor_turn(tree: DesignedTree) -> None:
    tree.root.division, tree.root.trial = Division.GAP, None
    assert renewed(tree, {"": 90, "0": 1, "1": 2})[0].judged == 2
    assert tree.root.fit.pixels.size == 0
    assert (tree.root.trial, tree.root.judged, tree.root.age) == (None, BEFORE, 90)


def test_a_tree_without_splits_has_none_to_judge() -> None:
    report, rejected = renewed(designed_tree(Band("", 80)), {})
    assert (report.judged, report.oldest, rejected) == (0, 0, set())


PLACES_MIN = 25.0
REJECTED = Trial("mse", 2.0, 60, ((2.0, 30), (2.0, 30)), False)


def leaf_of(
    tree: DesignedTree,
    *,
    places: int = 51,
    surface: bool = True,
    noise: bool = False,
    cuts_above: int = 7,
    attempt: Attempt | None = None,
) -> LiveLeaf:
    """A leaf with all that decides over its reason; without a word a new one that may be split."""
    on_wall = tree.leaves[0].node.fit.surface if surface else None
    values = {"mse": 1.0} if surface else {}
    fit = Fit(on_wall, np.zeros(places), values, "", np.arange(places), 1.0 if noise else 0.5)
    node = Node("0", np.arange(places), fit, cuts_above=cuts_above, trial=REJECTED)
    return LiveLeaf(node, attempt=attempt)


@pytest.mark.parametrize(
    ("leaf", "cuts", "stop"),
    [
        # Each has all that follows it as well, and the first of them is the reason.
        ({"places": 0, "surface": False, "noise": True, "cuts_above": 8}, 60, StopReason.NO_POINTS),
        ({"places": 1, "surface": False, "noise": True, "cuts_above": 8}, 60, StopReason.NO_FIT),
        ({"places": 50, "noise": True, "cuts_above": 8}, 60, StopReason.NOISE),
        ({"places": 49, "cuts_above": 8}, 60, StopReason.TOO_SMALL),
        ({"places": 50, "cuts_above": 8}, 60, StopReason.TOO_SMALL),
        ({"cuts_above": 8}, 60, StopReason.DEPTH),
        ({"cuts_above": 9}, 60, StopReason.DEPTH),
        ({}, 60, StopReason.SPLITS),
        ({}, 61, StopReason.SPLITS),
        ({}, 59, StopReason.UNTRIED),
    ],
)
def test_a_leaf_has_the_first_reason_of_this_frame(
    tree: DesignedTree, leaf: dict[str, int], cuts: int, stop: StopReason
) -> None:
    living = leaf_of(tree, **leaf)
    set_stop_reasons([living], cuts, PLACES_MIN, FRAME, CONFIG)
    node = living.node
    assert (node.stop, node.trial, node.measured, node.judged) == (stop, None, FRAME, FRAME)


@pytest.mark.parametrize(
    ("attempt", "leaf", "stop", "judged_in"),
    [
        (Attempt(StopReason.CRITERION, REJECTED, 30), {}, StopReason.CRITERION, 30),
        (Attempt(StopReason.NO_CUT, None, 30), {}, StopReason.NO_CUT, 30),
        # What this frame says goes before; a trial is told with it.
        (Attempt(StopReason.CRITERION, REJECTED, 30), {"noise": True}, StopReason.NOISE, 30),
        (Attempt(StopReason.NO_CUT, None, 30), {"noise": True}, StopReason.NOISE, FRAME),
        (Attempt(StopReason.CRITERION, REJECTED, 30), {"cuts_above": 8}, StopReason.DEPTH, 30),
    ],
)
def test_a_leaf_has_its_last_trial(
    tree: DesignedTree, attempt: Attempt, leaf: dict[str, int], stop: StopReason, judged_in: int
) -> None:
    living = leaf_of(tree, attempt=attempt, **leaf)
    # As many cuts as are allowed: what was tried before that says more.
    set_stop_reasons([leaf_of(tree), living], 1, PLACES_MIN, FRAME, replace(CONFIG, splits_max=1))
    node = living.node
    assert (node.stop, node.trial, node.measured, node.judged) == (stop, attempt.trial, FRAME, judged_in)


def test_the_noise_forbids_nothing_below_a_ratio_of_its_own(tree: DesignedTree) -> None:
    # A floor of half the value: no ratio is below 0.5, but one may be below 0.6.
    for most, stop in ((0.5, StopReason.NOISE), (0.6, StopReason.UNTRIED)):
        living = leaf_of(tree)
        set_stop_reasons([living], 0, PLACES_MIN, FRAME, replace(CONFIG, ratio_max=most))
        assert living.node.stop is stop
