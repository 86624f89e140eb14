from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nurbseg.library.tree_layout import fitted, tree_positions


@st.composite
def trees(draw: st.DrawFn) -> dict[str, tuple[str, ...]]:
    """Return a binary tree made of random splits."""
    leaves, children = [""], {}
    for _ in range(draw(st.integers(0, 40))):
        name = leaves.pop(draw(st.integers(0, len(leaves) - 1)))
        children[name] = (name + "0", name + "1")
        leaves += children[name]
    return children


def test_a_single_node_is_at_the_origin() -> None:
    assert tree_positions({}, "") == {"": (0.0, 0)}


def test_a_parent_stands_over_the_middle_of_its_children() -> None:
    assert tree_positions({"": ("0", "1")}, "") == {"": (0.5, 0), "0": (0.0, 1), "1": (1.0, 1)}


@given(trees())
def test_leaves_stand_side_by_side_and_no_subtree_over_another(children: dict[str, tuple[str, ...]]) -> None:
    positions = tree_positions(children, "")
    assert set(positions) == {""} | {child for pair in children.values() for child in pair}
    leaves = sorted(name for name in positions if name not in children)
    assert [positions[name][0] for name in leaves] == list(range(len(leaves)))
    for first, second in children.values():
        left = [x for name, (x, _) in positions.items() if name.startswith(first)]
        right = [x for name, (x, _) in positions.items() if name.startswith(second)]
        assert max(left) < min(right)


@given(trees())
def test_no_two_nodes_of_a_level_are_nearer_than_one(children: dict[str, tuple[str, ...]]) -> None:
    positions = tree_positions(children, "")
    assert set(positions) == {""} | {child for pair in children.values() for child in pair}
    for level in {level for _, level in positions.values()}:
        row = [(name, x) for name, (x, at) in positions.items() if at == level]
        by_place = sorted(row, key=lambda each: each[1])
        assert all(b[1] - a[1] >= 1.0 - 1e-9 for a, b in pairwise(by_place))
        # From left to right as the names count: edges do not cross.
        assert [name for name, _ in by_place] == sorted(name for name, _ in row)


@given(trees())
def test_children_are_centred_below_their_parent(children: dict[str, tuple[str, ...]]) -> None:
    positions = tree_positions(children, "")
    assert min(x for x, _ in positions.values()) == 0.0
    for parent, (first, second) in children.items():
        assert positions[parent][0] == pytest.approx((positions[first][0] + positions[second][0]) / 2)
        assert positions[first][1] == positions[second][1] == positions[parent][1] + 1


def test_a_subtree_is_drawn_alike_wherever_it_hangs() -> None:
    part = {"": ("0", "1"), "1": ("10", "11")}
    whole = {"": ("0", "1"), "0": ("00", "01"), "1": ("10", "11")}
    for name, (first, second) in part.items():
        for side in "01":
            whole[side + name] = (side + first, side + second)
    positions = tree_positions(whole, "")
    for name in ("0", "1", "10", "11"):
        offsets = [positions[side + name][0] - positions[side][0] for side in "01"]
        assert offsets[0] == pytest.approx(offsets[1])


@given(trees())
def test_the_drawing_fits_its_box(children: dict[str, tuple[str, ...]]) -> None:
    positions = list(tree_positions(children, "").values())
    places, spacing = fitted(positions, 1000.0, 500.0, 70.0, 90.0)
    assert 0.0 < spacing <= 70.0
    assert (places >= 0).all()
    assert (places <= [1000.0, 500.0]).all()
    assert places[:, 0].min() + places[:, 0].max() == pytest.approx(1000.0, abs=0.1)
    assert places.dtype == np.float32
