"""What of a tree is updated: which leaves, in which order, as far as the budget goes, and to what end."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from designed_tree import BEFORE, CONFIG, FRAME, GRID, Band, DesignedTree, designed_tree

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.leaf import Attempt
from nurbseg.segmentation.live.updater import Budget
from nurbseg.segmentation.segments import Node, Trial, depth_first
from nurbseg.segmentation.vocabulary import Division, StopReason

NOTHING = Budget(refits=0, trials=0, merges=0)


@pytest.fixture
def thirds() -> DesignedTree:
    """Three leaves of one wall."""
    return designed_tree(Band("0", 20), Band("10", 30), Band("11", 30))


def known(
    tree: DesignedTree, *, level: Sequence[float], age: Sequence[int], tried: Sequence[float] = (9, 9, 9)
) -> None:
    """Say how well leaves were explained when they were fitted, how long ago, and when they were tried."""
    for leaf, own_level, own_age, own_tried in zip(tree.leaves, level, age, tried, strict=True):
        leaf.level, leaf.age, leaf.tried = own_level, own_age, own_tried


def refitted(tree: DesignedTree, most: int, **measures: Sequence[float]) -> list[int]:
    """Labels of the leaves that are fitted anew, by their surfaces."""
    before = [leaf.surface for leaf in tree.leaves]
    done = tree.update(budget=Budget(refits=most, trials=0, merges=0), **measures)
    found = []
    for label, (leaf, surface) in enumerate(zip(tree.leaves, before, strict=True), start=1):
        if leaf.surface is surface:
            continue
        found.append(label)
        assert leaf.surface is leaf.node.fit.surface
        assert leaf.age == 0
        assert np.isnan(leaf.level)
        assert np.array_equal(leaf.node.grid_pixels, np.flatnonzero(tree.labels == label))
        assert leaf.node.fit.pixels.size == leaf.node.grid_pixels.size
    assert done.report.refits == len(found) <= most
    return found


@pytest.mark.parametrize(
    ("level", "age", "measures", "order"),
    [
        # Worse than after the last fit, in shares of that and a half: 4/3, 0 and 2/3.
        ((1, 1, 1), (0, 0, 0), {"square": (3, 1, 2)}, [1, 3]),
        # 1/2 and 5/4.5: the one that has become worse by less has become worse.
        ((0, 4, 1), (0, 0, 0), {"square": (0.25, 9, 1)}, [2, 1]),
        # A frame wears as much as a twentieth of that.
        ((1, 1, 1), (0, 14, 13), {"square": (2, 1, 1)}, [2, 1, 3]),
        # Places out of reach count twentyfold: 1.00 beside 1.02 and 0.98.
        ((1, 1, 1), (0, 0, 0), {"square": (1, 2.53, 2.47), "unreached": (0.05, 0, 0)}, [2, 1, 3]),
        # Nothing is known of the level: 1 is what noise leaves, unless the surface is new.
        ((np.nan, np.nan, 1), (2, 1, 0), {"square": (1.5, 5, 1)}, [1, 2]),
        # Better than ever and new.
        ((2, 2, 2), (0, 0, 0), {"square": (1, 1, 1)}, []),
    ],
)
def test_the_worst_explained_leaves_are_refitted(
    level: Sequence[float], age: Sequence[int], measures: dict[str, Sequence[float]], order: list[int]
) -> None:
    for most in range(4):
        tree = designed_tree(Band("0", 20), Band("10", 30), Band("11", 30))
        known(tree, level=level, age=age)
        assert refitted(tree, most, **measures) == sorted(order[:most])


def test_a_hidden_leaf_keeps_its_surface(thirds: DesignedTree) -> None:
    known(thirds, level=(1, 1, 1), age=(50, 0, 0))
    thirds.labels[:, :20] = 0
    before = thirds.leaves[0].surface
    thirds.update(square=(9, 1, 1), budget=Budget(refits=1, trials=0, merges=0))
    assert thirds.leaves[0].surface is before
    assert thirds.leaves[0].age == 50


def appearing(*corners: tuple[int, int]) -> np.ndarray:
    """Squares of five places that no leaf explains, numbered in this order."""
    appeared = np.zeros(GRID, np.int32)
    for number, (row, column) in enumerate(corners, start=1):
        appeared[row : row + 5, column : column + 5] = number
    return appeared


def test_new_components_become_siblings_of_their_surroundings_six_per_frame() -> None:
    tree = designed_tree(Band("0", 40), Band("1", 40))
    corners = [(4, 4), (4, 50), (20, 4), (20, 50), (40, 4), (40, 50), (50, 20), (50, 60)]
    appeared = appearing(*corners)
    tree.labels[appeared > 0] = 0
    done = tree.update(appeared=appeared)
    assert done.report.appeared == 6
    # Three in each half; what waits is of its surroundings until then.
    images = done.final[done.on_grid]
    values = [images[row + 2, column + 2] for row, column in corners]
    assert len(set(values)) == 8
    assert len(done.leaves) == 8
    assert values[6:] == [images[0, 0], images[0, 79]]
    for (row, column), label in zip(corners[:6], values[:6], strict=True):
        assert (images[row : row + 5, column : column + 5] == label).all()
        leaf = done.leaves[label - 1]
        assert leaf.node.name[0] == ("0" if column < 40 else "1")
        assert leaf.node.grid_pixels.size == 25
        assert leaf.tried == 0.0
    shown = [node for node in depth_first(tree.root) if node.division is Division.APPEARED]
    assert len(shown) == 6
    assert {node.judged for node in shown} == {FRAME}


@pytest.mark.parametrize(("places", "gone"), [(6, True), (7, False)])
def test_a_leaf_below_a_quarter_of_the_smallest_size_is_removed(places: int, gone: bool) -> None:
    # The least is 25 places. The last band stands in the first one, which is smaller than the second.
    tree = designed_tree(Band("0", 30), Band("10", 50), Band("11", 0))
    tree.labels[30, 10 : 10 + places] = 3
    done = tree.update()
    assert len(done.leaves) == (2 if gone else 3)
    assert (done.final[3] == done.final[1]) == gone


def test_of_leaves_that_are_all_next_to_nothing_the_last_stays(thirds: DesignedTree) -> None:
    # Nothing is around them; the first is the largest itself.
    thirds.labels[:] = 0
    thirds.labels[5, 5:8], thirds.labels[20, 5:7], thirds.labels[40, 5] = 1, 2, 3
    last = thirds.leaves[2]
    done = thirds.update()
    assert done.leaves == [last]
    assert done.final.tolist() == [0, 1, 1, 1]
    assert thirds.root.children == ()


def test_a_frame_that_shows_no_leaf_takes_out_all_but_the_last(thirds: DesignedTree) -> None:
    thirds.labels[:] = 0
    last = thirds.leaves[2]
    assert thirds.update().leaves == [last]


#: A plate in each of three bands.
PLATES = ((6, 0, 24, 40), (54, 0, 30, 40), (114, 0, 30, 40))


def divided(rows: Sequence[int]) -> DesignedTree:
    """Three leaves, each of them with a plate before the wall: 20, 30 and 30 places in each row."""
    bands = [
        Band(name, columns, rows=row)
        for name, columns, row in zip(("0", "10", "11"), (20, 30, 30), rows, strict=True)
    ]
    tree = designed_tree(*bands, boxes=PLATES)
    known(tree, level=(1, 1, 1), age=(0, 0, 0), tried=(1, 1, 1))
    return tree


def tried(
    tree: DesignedTree, square: Sequence[float], most: int = 3, config: SegmentationConfig = CONFIG
) -> tuple[list[int], int]:
    """Labels of the leaves that are tried, and how many wait."""
    labels = {id(leaf): label for label, leaf in enumerate(tree.leaves, start=1)}
    before = {id(leaf): leaf.node.name for leaf in tree.leaves}
    done = tree.update(square=square, budget=Budget(refits=0, trials=most, merges=0), config=config)
    found = [label for leaf, label in labels.items() if tree.leaves[label - 1].node.name != before[leaf]]
    assert done.report.trials == done.report.splits == len(found)
    return found, done.report.waiting


@pytest.mark.parametrize(
    ("square", "order"),
    [
        # One and a half of the last trial, and a half: up to 2 nothing has become worse.
        ((2.0, 2.01, 2.0), [2]),
        # By the square root of the places: 9 x 21.9, 7 x 26.8 and 6.9 x 26.8.
        ((9.0, 7.0, 6.9), [1, 2, 3]),
        ((8.0, 7.0, 6.9), [2, 3, 1]),
    ],
)
def test_leaves_that_have_become_worse_are_tried_the_worst_first(
    square: Sequence[float], order: list[int]
) -> None:
    for most in range(4):
        tree = divided((24, 24, 24))
        assert tried(tree, square, most) == (
            sorted(order[:most]),
            len(order[most:]) if most < len(order) else 0,
        )


def test_no_more_places_are_cut_than_there_is_room_for_unless_one_leaf_has_them() -> None:
    # 600, 900 and 480 places are fewer than 2000; 600, 900 and 510 are not.
    assert tried(divided((30, 30, 16)), (9, 9, 9)) == ([1, 2, 3], 0)
    assert tried(divided((30, 30, 17)), (9, 9, 9)) == ([1, 2], 1)
    assert tried(divided((40, 40, 40)), (9, 9, 8)) == ([2], 2)
    whole = designed_tree(Band("", 80), boxes=PLATES)
    whole.leaves[0].tried = 1.0
    assert tried(whole, (9,)) == ([1], 0)


def test_no_more_are_tried_than_splits_are_allowed() -> None:
    # Two cuts are there already; who may not be split does not wait.
    for allowed, found in ((2, []), (3, [1]), (4, [1, 2]), (5, [1, 2, 3])):
        config = replace(CONFIG, splits_max=allowed)
        assert tried(divided((24, 24, 24)), (9.0, 7.0, 6.9), config=config) == (found, 0)
    # One and two cuts are above them.
    for allowed, found in ((1, []), (2, [1]), (3, [1, 2, 3])):
        config = replace(CONFIG, depth_max=allowed)
        assert tried(divided((24, 24, 24)), (9.0, 7.0, 6.9), config=config) == (found, 0)


@pytest.mark.parametrize(("rows", "is_tried"), [(3, True), (2, False)])
def test_a_leaf_of_twice_the_least_is_not_tried(rows: int, is_tried: bool) -> None:
    # 60 or 40 places, where the least is 25.
    tree = divided((rows, 24, 24))
    done = tree.update(square=(9, 0, 0), budget=Budget(refits=0, trials=3, merges=0))
    assert done.report.trials == is_tried
    assert tree.leaves[0].tried == (9.0 if is_tried else 1.0)


def test_a_leaf_that_is_split_becomes_its_parts() -> None:
    tree = divided((50, 50, 50))
    node = tree.leaves[1].node
    done = tree.update(square=(0, 9, 0), budget=Budget(refits=0, trials=1, merges=0))
    assert (node.division, node.judged, node.measured, node.age) == (Division.CUT, FRAME, FRAME, 0)
    assert node.trial is not None
    assert node.trial.kept
    parts = [leaf.node for leaf in done.leaves if leaf.node.name.startswith("10")]
    assert len(parts) == len(done.leaves) - 2 >= 2
    assert {part.judged for part in parts} == {FRAME}
    # The largest part goes on as the leaf that was there, and the labels are those of the parts.
    (goes_on,) = [leaf for leaf in done.leaves if leaf is tree.leaves[1]]
    assert goes_on.node.grid_pixels.size == max(part.grid_pixels.size for part in parts)
    assert goes_on.surface is goes_on.node.fit.surface
    for label, leaf in enumerate(done.leaves, start=1):
        assert np.array_equal(np.flatnonzero(done.final[done.on_grid] == label), leaf.node.grid_pixels)
        assert leaf.tried == (0.0 if leaf.node in parts else 1.0)


def test_a_leaf_that_noise_explains_is_not_cut_and_keeps_no_attempt(thirds: DesignedTree) -> None:
    known(thirds, level=(1, 1, 1), age=(7, 7, 7), tried=(1, 1, 1))
    leaf = thirds.leaves[1]
    leaf.attempt = Attempt(StopReason.CRITERION, None, BEFORE)
    # As it is, it is far from the noise.
    leaf.node.fit = type(leaf.node.fit)(leaf.surface, np.zeros(1), {"mse": 1.0}, "", np.zeros(1, np.intp))
    done = thirds.update(square=(0, 9, 0), budget=Budget(refits=0, trials=1, merges=0))
    assert (done.report.trials, done.report.splits, done.report.waiting) == (1, 0, 0)
    assert (leaf.attempt, leaf.tried, leaf.age) == (None, 9.0, 0)
    assert leaf.node.fit.values["mse"] < 1e-5


@pytest.mark.parametrize(
    ("ages", "left"),
    [
        # With two attempts one is forgotten at 298, which both can be before they are 300.
        ((297, 100, None), [297, 100]),
        ((298, 100, None), [100]),
        ((298, 298, 299), [298, 298]),
        ((299, None, None), []),
        ((298, None, None), [298]),
    ],
)
def test_the_oldest_attempt_is_forgotten_before_it_is_too_old(
    thirds: DesignedTree, ages: Sequence[int | None], left: list[int]
) -> None:
    known(thirds, level=(1, 1, 1), age=(0, 0, 0))
    for leaf, age in zip(thirds.leaves, ages, strict=True):
        leaf.attempt = None if age is None else Attempt(StopReason.NO_CUT, None, BEFORE, age)
    thirds.update()
    assert [leaf.attempt.age for leaf in thirds.leaves if leaf.attempt is not None] == left
    forgotten = [leaf for leaf, age in zip(thirds.leaves, ages, strict=True) if age and leaf.attempt is None]
    assert all(leaf.tried == 0.0 for leaf in forgotten)


@pytest.fixture
def flush() -> DesignedTree:
    """A plate, and three leaves of the wall beside it."""
    return designed_tree(Band("0", 20, 0.02), Band("10", 18), Band("110", 12), Band("111", 30))


def test_a_split_that_is_not_kept_is_undone(flush: DesignedTree) -> None:
    largest = flush.leaves[3]
    wall = flush.nodes["1"]
    done = flush.update(rejected=[wall])
    assert done.report.merges == 1
    assert done.leaves == [flush.leaves[0], largest]
    assert done.final.tolist() == [0, 1, 2, 2, 2]
    assert largest.node is wall
    assert (wall.children, wall.division) == ((), None)
    assert np.array_equal(wall.grid_pixels, np.flatnonzero(flush.labels > 1))
    assert largest.surface is wall.fit.surface is not None
    assert (largest.age, np.isnan(largest.level), largest.tried) == (0, True, 0.0)
    assert largest.attempt is not None
    assert (largest.attempt.stop, largest.attempt.frame) == (StopReason.CRITERION, FRAME)
    trial = largest.attempt.trial
    assert trial is not None
    assert not trial.kept
    assert (trial.points, [n for _, n in trial.parts]) == (3600, [1080, 720, 1800])
    assert trial.ratio >= 1.0


def test_a_split_that_fitted_surfaces_keep_stays(flush: DesignedTree) -> None:
    root = flush.root
    root.age = 50
    done = flush.update(rejected=[root])
    assert done.report.merges == 0
    assert len(done.leaves) == 4
    assert (root.division, root.judged, root.age) == (Division.CUT, FRAME, 0)
    assert root.trial is not None
    assert root.trial.kept
    assert root.trial.ratio < 0.5
    # The whole and the leaves below it, each at its own places.
    assert (root.trial.points, [n for _, n in root.trial.parts]) == (4800, [1200, 1080, 720, 1800])


def test_what_is_no_split_any_more_is_not_undone(flush: DesignedTree) -> None:
    elsewhere = Node("1", flush.nodes["1"].grid_pixels, flush.nodes["1"].fit, flush.nodes["1"].children)
    done = flush.update(rejected=[flush.nodes["0"], elsewhere])
    assert done.report.merges == 0
    assert len(done.leaves) == 4


def test_a_split_whose_leaves_are_out_of_sight_is_left_alone() -> None:
    tree = designed_tree(Band("0", 30), Band("10", 25), Band("11", 25))
    tree.labels[tree.labels > 1] = 0
    done = tree.update(rejected=[tree.nodes["1"]])
    assert done.report.merges == 0
    assert done.leaves == tree.leaves[:1]
    # And a part that is out of sight is none of the split's.
    tree = designed_tree(Band("0", 30), Band("100", 20), Band("101", 15), Band("11", 15))
    tree.labels[tree.labels == 3] = 0
    tree.update(rejected=[tree.nodes["1"]], config=replace(CONFIG, ratio_max=0.5))
    attempt = tree.leaves[1].attempt
    assert attempt is not None
    assert attempt.trial is not None
    assert [n for _, n in attempt.trial.parts] == [1200, 900]


def test_the_larger_of_two_leaves_of_an_object_takes_in_the_other_where_one_surface_serves() -> None:
    for columns, kept in (((50, 30), 1), ((30, 50), 2)):
        tree = designed_tree(Band("0", columns[0]), Band("1", columns[1]))
        leaf = tree.leaves[kept - 1]
        done = tree.update(same_object=[(1, 2)], budget=Budget(refits=0, trials=0, merges=1))
        assert done.report.merges == 1
        assert done.leaves == [leaf]
        assert done.final.tolist() == [0, 1, 1]
        assert leaf.node.grid_pixels.size == 4800
        assert leaf.surface is leaf.node.fit.surface is not None
        assert leaf.attempt is not None
        assert leaf.attempt.trial is not None
        assert [n for _, n in leaf.attempt.trial.parts] == [60 * each for each in columns]


def test_leaves_stay_two_where_they_are_better_so_or_no_object() -> None:
    apart = designed_tree(Band("0", 40, 0.02), Band("1", 40))
    assert len(apart.update(same_object=[(1, 2)], budget=Budget(refits=0, trials=0, merges=1)).leaves) == 2
    flush = designed_tree(Band("0", 40), Band("1", 40))
    assert len(flush.update(budget=Budget(refits=0, trials=0, merges=1)).leaves) == 2
    assert len(flush.update(same_object=[(1, 2)]).leaves) == 2


def test_leaves_that_only_moved_surfaces_separate_are_compared_with_new_fits() -> None:
    # As they are they explain the wall perfectly; fitted anew they do not do so any better than one.
    tree = designed_tree(Band("0", 40), Band("1", 40))
    for leaf in tree.leaves:
        leaf.node.fit = type(leaf.node.fit)(
            leaf.surface, np.zeros(1), {"mse": 1e-12}, "", leaf.node.fit.pixels
        )
    assert len(tree.update(same_object=[(1, 2)], budget=Budget(refits=0, trials=0, merges=1)).leaves) == 2
    # And the other way round: as they are they are worse than one, fitted they are not.
    tree = designed_tree(Band("0", 40, 0.02), Band("1", 40))
    for leaf in tree.leaves:
        leaf.node.fit = type(leaf.node.fit)(leaf.surface, np.zeros(1), {"mse": 1.0}, "", leaf.node.fit.pixels)
    assert len(tree.update(same_object=[(1, 2)], budget=Budget(refits=0, trials=0, merges=1)).leaves) == 2


def test_pairs_are_compared_in_turn() -> None:
    tree = designed_tree(Band("0", 20, 0.02), Band("10", 30), Band("11", 30))
    pairs, one = [(1, 2), (2, 3)], Budget(refits=0, trials=0, merges=1)
    # First the plate and the wall, which stay apart; then the halves of the wall, in spite of their number.
    assert tree.update(same_object=pairs, budget=one).report.merges == 0
    assert tree.update(same_object=pairs, budget=one).report.merges == 1
    tree = designed_tree(Band("0", 20, 0.02), Band("10", 30), Band("11", 30))
    assert tree.update(same_object=pairs, budget=Budget(refits=0, trials=0, merges=2)).report.merges == 1


def test_labels_of_the_frame_before_are_known_after_an_update(flush: DesignedTree) -> None:
    assert flush.update(rejected=[flush.nodes["1"]]).final.tolist() == [0, 1, 2, 2, 2]


def test_nothing_is_done_without_need(thirds: DesignedTree) -> None:
    known(thirds, level=(1, 1, 1), age=(0, 0, 0))
    before = [(leaf, leaf.surface, leaf.node.name) for leaf in thirds.leaves]
    done = thirds.update(budget=Budget())
    assert [(leaf, leaf.surface, leaf.node.name) for leaf in done.leaves] == before
    assert (
        done.report.refits,
        done.report.trials,
        done.report.splits,
        done.report.appeared,
        done.report.merges,
        done.report.waiting,
    ) == (0,) * 6
    assert isinstance(thirds.root.trial, Trial)
