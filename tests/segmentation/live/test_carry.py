"""The tree of the frame before, carried into a frame: its leaves, their parts, and what is new or gone."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plates import CONFIG, cloud_of, plates

from nurbseg.common.settings import updated
from nurbseg.segmentation.extended.grid_features import GridFeatures, grid_features
from nurbseg.segmentation.extended.memory import LeafMemory
from nurbseg.segmentation.extended.parts import fit_segment
from nurbseg.segmentation.live.carry import Carried, carried_labels, carry_tree
from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.segments import Node, depth_first, leaves_below
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice
from nurbseg.segmentation.vocabulary import Division, StopReason

GRID = (60, 80)
#: T_p is 25 grid pixels. In front of all rows of the grid from column 30 to 39.
BAR = (60, 0, 20, 120)


def halves(column: int = 40) -> tuple[Node, GridFeatures, NDArray[np.int32]]:
    """A root that is cut into two leaves at a column, the frame, and the labels of the leaves."""
    features = grid_features(plates(), CONFIG)
    labels = np.where(np.arange(GRID[1]) < column, 1, 2) * np.ones((GRID[0], 1), dtype=np.int32)
    parts = [fit_segment(features, np.flatnonzero(labels == label), CONFIG) for label in (1, 2)]
    for n, part in enumerate(parts):
        part.name, part.cuts_above, part.memory = str(n), 1, LeafMemory(0)
        part.measured = part.judged = 3
    root = fit_segment(features, np.arange(labels.size), CONFIG)
    root.children, root.division, root.stop = (parts[0], parts[1]), Division.CUT, None
    root.measured = root.judged = 3
    return root, features, labels.astype(np.int32)


def carried(
    root: Node, labels: NDArray[np.int32], features: GridFeatures
) -> tuple[int | None, list[list[int]]]:
    """Carry a tree; return how many leaves appeared, and the grid pixels of all leaves."""
    appeared = carry_tree(root, labels, 8, features, CONFIG)
    for node in depth_first(root):
        below = np.concatenate([leaf.grid_pixels for leaf in leaves_below(node)])
        assert np.array_equal(np.sort(node.grid_pixels), np.sort(below))
        assert all(child.name == f"{node.name}{n}" for n, child in enumerate(node.children))
        if not node.children:
            # Fitted in this frame, to its pixels.
            assert node.fit.surface is not None
            assert node.measured is None
            assert node.fit.residuals_m.size == node.grid_pixels.size
        elif node.division is not Division.CUT:
            assert node.fit.surface is None
    return appeared, [leaf.grid_pixels.tolist() for leaf in leaves_below(root)]


def test_leaves_keep_their_memory_and_get_their_pixels_and_fits() -> None:
    root, features, labels = halves()
    before = [leaf.memory for leaf in leaves_below(root)]
    labels = np.roll(labels, 7, axis=1)
    labels[:, :7] = 1
    appeared, leaves = carried(root, labels, features)
    assert appeared == 0
    assert leaves == [np.flatnonzero(labels == label).tolist() for label in (1, 2)]
    assert [leaf.memory for leaf in leaves_below(root)] == before
    assert [leaf.fit.values["mse"] for leaf in leaves_below(root)] == [
        fit_segment(features, np.flatnonzero(labels == label), CONFIG).fit.values["mse"] for label in (1, 2)
    ]


def test_surfaces_of_cut_segments_are_dropped_and_their_values_kept() -> None:
    root, features, labels = halves()
    values = dict(root.fit.values)
    carried(root, labels, features)
    assert (root.fit.surface, root.fit.residuals_m.size, dict(root.fit.values)) == (None, 0, values)
    assert root.fit.reason == "measured in frame 3"


def test_a_leaf_that_is_not_connected_becomes_leaves_below_a_gap() -> None:
    root, _, _ = halves()
    features = grid_features(plates(thing=BAR), CONFIG)
    labels = np.ones(GRID, dtype=np.int32)
    labels[:, 30:40] = 2
    memories = [leaf.memory for leaf in leaves_below(root)]
    appeared, leaves = carried(root, labels, features)
    assert appeared == 0
    right, left = np.flatnonzero(np.arange(4800) % 80 >= 40), np.flatnonzero(np.arange(4800) % 80 < 30)
    assert leaves == [right.tolist(), left.tolist(), np.flatnonzero(labels == 2).tolist()]
    first = root.children[0]
    assert (first.division, first.judged) == (Division.GAP, None)
    # The larger part is what the leaf was; the other one remembers what it was cut off from.
    larger, smaller, bar = leaves_below(root)
    assert [larger.memory, bar.memory] == memories
    assert isinstance(smaller.memory, LeafMemory)
    assert (smaller.memory.born, smaller.memory.cut_from) == (8, memories[0])
    assert [each.cuts_above for each in (larger, smaller, bar)] == [1, 1, 1]


@pytest.mark.parametrize(("size", "is_leaf"), [(6, False), (7, True)])
def test_a_leaf_below_a_quarter_of_the_least_has_vanished(size: int, is_leaf: bool) -> None:
    root, features, labels = halves()
    labels[:] = 1
    labels[20, 30 : 30 + size] = 2
    kept = leaves_below(root)[0].memory
    _, leaves = carried(root, labels, features)
    assert len(leaves) == 1 + is_leaf
    assert sum(map(len, leaves)) == 4800
    assert leaves_below(root)[0].memory is kept
    if not is_leaf:
        assert (root.name, root.children, root.cuts_above) == ("", (), 0)


@pytest.mark.parametrize(("rows", "is_leaf"), [(9, False), (10, True)])
def test_a_part_that_is_cut_off_is_a_leaf_from_four_times_the_least_on(rows: int, is_leaf: bool) -> None:
    root, features, labels = halves()
    # 90 or 100 grid pixels on the other side.
    labels[20 : 20 + rows, 50:60] = 1
    _, leaves = carried(root, labels, features)
    assert len(leaves) == 2 + is_leaf


def test_points_that_nothing_explains_appear_beside_the_leaf_around_them() -> None:
    root, features, labels = halves()
    thing = np.s_[20:30, 60:70]
    labels[thing] = 0
    memory = leaves_below(root)[1].memory
    appeared, leaves = carried(root, labels, features)
    assert appeared == 1
    expected = np.zeros(GRID, dtype=bool)
    expected[thing] = True
    assert leaves[2] == np.flatnonzero(expected).tolist()
    around = root.children[1]
    assert around.division is Division.APPEARED
    assert around.children[0].memory is memory
    assert around.children[1].memory is None
    assert [child.cuts_above for child in around.children] == [1, 1]


def test_specks_that_nothing_explains_go_to_what_is_around_them() -> None:
    root, features, labels = halves()
    labels[20:24, 60:66] = 0
    appeared, leaves = carried(root, labels, features)
    assert appeared == 0
    assert [len(leaf) for leaf in leaves] == [2400, 2400]


def test_a_tree_of_which_nothing_is_left_is_not_changed() -> None:
    root, features, labels = halves()
    before = [(node, node.grid_pixels, node.fit) for node in depth_first(root)]
    assert carry_tree(root, np.zeros_like(labels), 8, features, CONFIG) is None
    assert [(node, node.grid_pixels, node.fit) for node in depth_first(root)] == before


def into(inverse_depth: NDArray[np.float64]) -> Carried:
    """The labels of the halves of a wall, carried into another frame of it."""
    root, _, labels = halves()
    leaves = leaves_below(root)
    return carried_labels(
        np.kron(labels, np.ones((2, 2))).astype(np.uint16),
        SurfaceLattice([leaf.fit.surface for leaf in leaves], 2),
        [leaf.fit.rms_per_m for leaf in leaves],
        grid_features(cloud_of(inverse_depth, np.full((120, 160, 3), 120.0), 5), CONFIG),
        CONFIG,
    )


def test_points_keep_a_label_whose_moved_surface_explains_them() -> None:
    rows, columns = np.mgrid[:120, :160]
    labels = halves()[2]
    # As the camera turns, or goes nearer.
    for change in (0.0, 0.02, 2e-4 * columns - 1e-4 * rows):
        assert np.array_equal(into(0.7 + change * np.ones((120, 160))).labels, labels)
    # What has come before it is free, and draws no surface along.
    thing = (rows >= 40) & (rows < 60) & (columns >= 100) & (columns < 130)
    found = into(np.where(thing, 0.8, 0.71))
    assert found.is_same_scene
    assert np.array_equal(found.labels, np.where(thing[::2, ::2], 0, labels))


@pytest.mark.parametrize(("rows", "is_same"), [(8, True), (12, False)])
def test_a_scene_is_another_one_where_surfaces_do_not_explain_enough(rows: int, is_same: bool) -> None:
    inverse_depth = np.full((120, 160), 0.7)
    # 6.7 or 10 % of the rows.
    inverse_depth[:rows] = 1.2
    found = into(inverse_depth)
    assert found.unexplained == pytest.approx(rows / 120, abs=0.005)
    assert found.is_same_scene == is_same


@pytest.mark.parametrize(("size", "is_shown"), [(6, False), (7, True)])
def test_what_was_hardly_shown_is_not_carried(size: int, is_shown: bool) -> None:
    features = grid_features(plates(), CONFIG)
    labels = np.ones(GRID, dtype=np.int32)
    labels[20:30, 30:40] = 2
    fits = [fit_segment(features, np.flatnonzero(labels == label), CONFIG).fit for label in (1, 2)]
    # Borders have moved over most of it. Its own surface would explain all of it again.
    labels[20:30, 30:40] = 1
    labels[25, 32 : 32 + size] = 2
    found = carried_labels(
        np.kron(labels, np.ones((2, 2))).astype(np.uint16),
        SurfaceLattice([fit.surface for fit in fits], 2),
        [fit.rms_per_m for fit in fits],
        features,
        CONFIG,
    )
    assert np.array_equal(found.labels, labels if is_shown else np.ones(GRID))
    assert found.unexplained < 0.01


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
