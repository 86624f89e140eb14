import numpy as np
import pytest
from scipy import ndimage

from nurbseg.segmentation.labels.regions import pixel_adjacency
from nurbseg.segmentation.live.editor import TreeEditor
from nurbseg.segmentation.live.leaf import LiveLeaf
from nurbseg.segmentation.segments import Node, Trial, depth_first
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.vocabulary import Division, StopReason


def editor_of(labels):
    fit = Fit(None, np.zeros(0), {}, "", np.zeros(0, dtype=np.intp))
    root = Node("", np.zeros(0, dtype=np.intp), fit)
    # As many leaves as there are labels; none of them is asked for anything here.
    return TreeEditor(root, [None] * int(labels.max()), labels)


@pytest.mark.parametrize("step", [1, 2, 3])
def test_pixels_with_the_label_of_their_place_change_with_it(step):
    rng = np.random.default_rng(step)
    h, w = 9, 13
    before = rng.integers(0, 4, (-(-h // step), -(-w // step))).astype(np.int32)
    after = rng.integers(0, 6, before.shape).astype(np.int32)
    labels = rng.integers(0, 4, (h, w)).astype(np.uint16)
    inverse_depth = rng.choice([0.0, 0.8], (h, w)).astype(np.float32)
    labels[inverse_depth == 0] = 0
    final = np.array([0, 3, 1, 2, 5, 4], dtype=np.uint16)
    editor = editor_of(before)
    editor.labels[:] = after
    found = editor.relabelled(labels, final, inverse_depth, step)
    for r, c in np.ndindex(h, w):
        place = r // step, c // step
        number = after[place] if labels[r, c] == before[place] else labels[r, c]
        # What has no point gets no label, whatever becomes of the place that it is beside.
        assert found[r, c] == (final[number] if inverse_depth[r, c] > 0 else 0)


def test_places_are_counted_by_number():
    labels = np.random.default_rng(0).integers(0, 7, (20, 30)).astype(np.int32)
    expected = np.bincount(labels.ravel(), minlength=int(labels.max()) + 1)
    expected[0] = 0
    assert (editor_of(labels).sizes() == expected).all()


def test_neighbors_meet_along_so_many_joined_places():
    rng = np.random.default_rng(3)
    labels = rng.integers(0, 6, (24, 31)).astype(np.int32)
    adjacency = pixel_adjacency(rng.random(labels.shape).astype(np.float32), labels > 0, 0.4)
    counts = {}
    for ahead, behind, among in (
        (labels[:, :-1], labels[:, 1:], adjacency.right[:, :-1]),
        (labels[:-1], labels[1:], adjacency.down[:-1]),
    ):
        for one, other in zip(ahead[among].tolist(), behind[among].tolist(), strict=True):
            if one != other:
                pair = min(one, other), max(one, other)
                counts[pair] = counts.get(pair, 0) + 1
    for least in {1, *counts.values()}:
        expected = sorted(pair for pair, number in counts.items() if number >= least)
        assert editor_of(labels).neighbors(adjacency, least) == expected


class Grown:
    """A tree of the leaves 00, 010, 011 and 1, with the numbers 1 to 4, on a grid of four columns."""

    def __init__(self):
        places = np.arange(24)
        column = places % 4
        self.labels = (1 + column).reshape(6, 4).astype(np.int32)
        self.nodes = {
            name: Node(name, places[inside], fit_of(places[inside]), cuts_above=len(name))
            for name, inside in (
                ("", column >= 0),
                ("0", column < 3),
                ("00", column == 0),
                ("01", (column == 1) | (column == 2)),
                ("010", column == 1),
                ("011", column == 2),
                ("1", column == 3),
            )
        }
        for name in ("", "0", "01"):
            node = self.nodes[name]
            node.children = self.nodes[f"{name}0"], self.nodes[f"{name}1"]
            node.division = Division.CUT
            node.trial = Trial("mse", 2.0, node.grid_pixels.size, ((1.0, node.grid_pixels.size),), True)
        for name in ("00", "010", "011", "1"):
            self.nodes[name].stop = StopReason.CRITERION
        for number, node in enumerate(self.nodes.values()):
            node.measured, node.judged, node.age = number, 10 + number, 20 + number
        self.leaves = [LiveLeaf(self.nodes[name]) for name in ("00", "010", "011", "1")]
        self.editor = TreeEditor(self.nodes[""], self.leaves, self.labels)

    def names(self):
        return [node.name for node in depth_first(self.nodes[""])]


def fit_of(places):
    return Fit(None, np.zeros(0), {}, "", places)


@pytest.mark.parametrize(
    ("absorbed", "names", "by_final", "final"),
    [
        # One of two at the bottom: the other is where both were.
        ([(2, 3)], ["", "0", "00", "01", "1"], [0, 2, 3], [0, 1, 2, 2, 3]),
        # A leaf whose other half has parts: these go up, and the kept is elsewhere.
        ([(1, 4)], ["", "0", "00", "01", "1"], [1, 2, 3], [0, 3, 1, 2, 3]),
        ([(4, 1)], ["", "0", "1", "10", "11"], [0, 1, 2], [0, 1, 2, 3, 1]),
        # An kept that goes itself.
        ([(1, 2), (2, 3)], ["", "0", "1"], [2, 3], [0, 1, 1, 1, 2]),
        ([(3, 2), (4, 2), (1, 2)], [""], [1], [0, 1, 1, 1, 1]),
    ],
)
def test_the_sibling_of_a_removed_leaf_takes_the_place_of_their_parent(absorbed, names, by_final, final):
    grown = Grown()
    kept_before = {leaf: leaf.node.grid_pixels for leaf in grown.leaves}
    times = {leaf: (leaf.node.measured, leaf.node.judged, leaf.node.age) for leaf in grown.leaves}
    for gone, kept in absorbed:
        grown.editor.merge_leaves(gone, kept)
    assert grown.names() == names
    leaves, labels = grown.editor.finished()
    assert leaves == [grown.leaves[n] for n in by_final]
    assert labels.tolist() == final
    for leaf in leaves:
        assert leaf.node.grid_pixels is kept_before[leaf]
        assert (leaf.node.measured, leaf.node.judged, leaf.node.age) == times[leaf]
        assert leaf.node.stop is StopReason.CRITERION
        assert not leaf.node.children
        assert leaf.node.division is None
        assert leaf.node.trial is None
    for node in depth_first(grown.nodes[""]):
        assert node.cuts_above == len(node.name)
        assert (node.division is Division.CUT) == bool(node.children) == (node.trial is not None)
    # The grid holds working numbers: those of the last heirs.
    last = dict(absorbed)
    expected = grown.labels.copy()
    for gone, kept in absorbed:
        expected[expected == gone] = kept
    assert (grown.editor.labels == expected).all()
    assert grown.labels.tolist() == [[1, 2, 3, 4]] * 6
    assert set(grown.editor.by_number) == {1, 2, 3, 4} - set(last)
    assert np.bincount(expected.ravel(), minlength=5).tolist() == grown.editor.sizes().tolist()


def test_an_added_leaf_has_the_next_number_and_no_trial():
    grown = Grown()
    for first in (0, 4):
        places = np.arange(first, first + 2)
        grown.editor.add_leaf(Node("2", places, fit_of(places)))
    assert [grown.editor.by_number[number].tried for number in (5, 6)] == [0.0, 0.0]
    assert grown.editor.labels[:3].tolist() == [[5, 5, 3, 4], [6, 6, 3, 4], [1, 2, 3, 4]]
    assert grown.editor.sizes().tolist() == [0, 4, 4, 6, 6, 2, 2]


@pytest.mark.parametrize("seed", range(8))
def test_a_place_is_surrounded_by_the_leaf_that_touches_it_most(seed):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 5, (4, 5)).repeat(5, axis=0).repeat(5, axis=1).astype(np.int32)
    labels[0, :4] = 1, 2, 3, 4
    mask = ndimage.binary_dilation(rng.random(labels.shape) < 0.02)
    touching = labels[ndimage.binary_dilation(mask, np.ones((3, 3))) & ~mask]
    counts = np.bincount(touching[touching > 0], minlength=5)
    assert counts[editor_of(labels).around(mask)] == counts.max() > 0


def test_pixels_that_touch_nothing_belong_to_the_largest_leaf():
    labels = np.zeros((8, 7), dtype=np.int32)
    labels[0, :3], labels[7] = 1, 2
    editor = editor_of(labels)
    mask = np.zeros(labels.shape, dtype=bool)
    mask[4, 3] = True
    assert editor.around(mask) == 2
    del editor.by_number[2]
    assert editor.around(mask) is None


def cut_tree():
    """A root cut into a leaf and a segment that was cut, one side of which something came into view in."""
    fit = Fit(None, np.zeros(0), {}, "", np.zeros(0, dtype=np.intp))

    def node(name, cuts_above, division=None, children=()):
        return Node(name, np.zeros(0, np.intp), fit, children, division, cuts_above=cuts_above)

    shown = node("11", 2, Division.APPEARED, (node("110", 2), node("111", 2)))
    root = node("", 0, Division.CUT, (node("0", 0 + 1), node("1", 1, Division.CUT, (node("10", 2), shown))))
    leaves = [LiveLeaf(each) for each in depth_first(root) if not each.children]
    return root, TreeEditor(root, leaves, np.array([[1, 2, 3, 4, 4]], np.int32))


def described(root):
    return [(each.name, each.division, each.cuts_above) for each in depth_first(root)]


def test_cuts_above_are_recounted_when_a_leaf_is_removed():
    root, editor = cut_tree()
    assert editor.cuts == 2
    editor.merge_leaves(1, 4)
    assert described(root) == [
        ("", Division.CUT, 0),
        ("0", None, 1),
        ("1", Division.APPEARED, 1),
        ("10", None, 1),
        ("11", None, 1),
    ]
    assert editor.cuts == 1


def test_a_split_undone_is_one_leaf_with_the_label_of_its_largest():
    root, editor = cut_tree()
    assert editor.contains(root.children[1])
    assert editor.collapse(root.children[1]) == 4
    assert described(root) == [("", Division.CUT, 0), ("0", None, 1), ("1", None, 1)]
    assert editor.by_number[4].node is root.children[1]
    assert editor.labels.tolist() == [[1, 4, 4, 4, 4]]
    assert editor.finished()[1].tolist() == [0, 1, 2, 2, 2]


def test_a_split_undone_leaves_the_others_what_they_have():
    grown = Grown()
    assert grown.editor.collapse(grown.nodes["0"]) == 1
    assert grown.names() == ["", "0", "1"]
    assert grown.editor.labels.tolist() == [[1, 1, 1, 4]] * 6
    assert grown.editor.finished()[1].tolist() == [0, 1, 1, 1, 2]
