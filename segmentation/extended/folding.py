"""Leaves of different branches that meet smoothly, and that one surface explains as well, are merged."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import I32, Bool, Intp, compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.grid_features import GridFeatures
from nurbseg.segmentation.extended.memory import LeafMemory
from nurbseg.segmentation.extended.parts import judge_split, nodes_of
from nurbseg.segmentation.growth import stop_without_cut
from nurbseg.segmentation.judged import JudgedSplit, Observer, unobserved
from nurbseg.segmentation.points.grid import union
from nurbseg.segmentation.segments import Node, Trial, depth_first, leaves_below
from nurbseg.segmentation.vocabulary import SPLITS, Division, StopReason

#: Least number of adjacent pairs of grid pixels of two leaves that meet.
BORDER_LEAST = 4
#: Least mean cosine of the angle between the normals on both sides of a smooth border: of 15 degrees.
_SMOOTH_COSINE = 0.966
#: Stop reasons of a tree that a limit ended.
UNFINISHED = {StopReason.SPLITS, StopReason.BUDGET}
#: Fields that a node takes over from its remaining child.
_INHERITED_FIELDS = [name for name in Node.__slots__ if name not in ("name", "cuts_above")]

_state = attrgetter(*Node.__slots__)

_Pair = tuple[int, int]


def fold_leaves(
    root: Node,
    features: GridFeatures,
    config: SegmentationConfig,
    is_asked: Callable[[Node, Node], bool] = lambda one, other: True,
    *,
    observe: Observer = unobserved,
) -> None:
    """Merge leaves that meet smoothly if the ratio does not keep them apart.

    The first cuts of a frame may divide a surface, whose parts then are in different branches. Two leaves
    meet smoothly if the normals on both sides of their border agree on average. If the ratio (eq. 5) would
    reject splitting one surface for both into the two, the smaller leaf is removed and its grid pixels go to
    the larger one. The segments above them are fitted and judged again; if the ratio rejects one of their
    splits, the two are not merged. The pair with the largest ratio comes first; a pair of which one has grown
    is judged again when its turn comes.

    Parameters
    ----------
    root : Node
        Of a grown tree, which is changed; one that a limit stopped is not.
    features : GridFeatures
        The frame.
    config : SegmentationConfig
        The metric, T and T_d.
    is_asked : callable
        Whether two leaves that meet are compared: in a tree that is continued only if one of them is new, or
        if they are parts of one leaf that meet again. Called once for each pair that meets.
    observe : callable
        Called with every pair of leaves that is compared with one surface for both.
    """
    leaves = dict(enumerate(leaves_below(root), start=1))
    if any(leaf.stop in UNFINISHED for leaf in leaves.values()):
        return
    ends, pair_of = _crossings(leaves, features)
    pairs = [divmod(number, len(leaves) + 1) for number in np.flatnonzero(np.bincount(pair_of)).tolist()]
    asked = [pair for pair in pairs if is_asked(*(leaves[number] for number in pair))]
    # They stay apart when one of them takes a leaf that meets the other.
    not_asked = {*pairs}.difference(asked)
    met = dict(zip(asked, _smoothness(asked, ends, pair_of, len(leaves) + 1, features), strict=True))
    judged: dict[_Pair, tuple[Node, Trial]] = {}
    # As last judged, perhaps before one of the two grew.
    ratios: dict[_Pair, float] = {}

    def is_candidate(pair: _Pair) -> bool:
        count, cosines = met[pair]
        if count < BORDER_LEAST or cosines <= _SMOOTH_COSINE * count:
            return False
        return pair not in judged or not judged[pair][1].kept

    while candidates := [pair for pair in met if is_candidate(pair)]:
        pair = max(candidates, key=lambda candidate: (ratios.get(candidate, math.inf), candidate))
        if pair not in judged:
            parts = [leaves[number] for number in pair]
            whole, trial = _judged(parts, features, config)
            observe(JudgedSplit(trial, (parts[0].fit, parts[1].fit), (0, 1), folded=True))
            judged[pair], ratios[pair] = (whole, trial), trial.ratio
            if whole.fit.surface is None:
                del met[pair]
            continue
        kept, gone = sorted(pair, key=lambda number: -leaves[number].grid_pixels.size)
        if not _fold(root, leaves, kept, gone, judged[pair], features, config):
            del judged[pair], met[pair]
            continue
        judged = {each: found for each, found in judged.items() if kept not in each and gone not in each}
        for each in [each for each in met if gone in each]:
            count, cosines = met.pop(each)
            other = each[0] if each[1] == gone else each[1]
            joint = min(kept, other), max(kept, other)
            if other != kept and joint not in not_asked:
                more_count, more_cosines = met.get(joint, (0, 0.0))
                met[joint] = count + more_count, cosines + more_cosines


def remove_node(root: Node, gone: Node) -> tuple[Node, Node]:
    """Remove a node from a tree: its sibling takes the place of their parent.

    Returns
    -------
    (Node, Node)
        The sibling, which is no longer in the tree, and the parent that has its fields now.
    """
    parent = next(node for node in depth_first(root) if gone in node.children)
    (sibling,) = (child for child in parent.children if child is not gone)
    for name in _INHERITED_FIELDS:
        setattr(parent, name, getattr(sibling, name))
    for node in depth_first(parent):
        for number, child in enumerate(node.children):
            child.name = f"{node.name}{number}"
            child.cuts_above = node.cuts_above + (node.division in SPLITS)
    return sibling, parent


def _crossings(
    leaves: Mapping[int, Node], features: GridFeatures
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return adjacent grid pixels of two leaves, (2, N) flat, and the number of each pair of leaves."""
    labels = np.zeros(features.grid.valid.shape, dtype=np.int32)
    for number, leaf in leaves.items():
        labels.reshape(-1)[leaf.grid_pixels] = number
    return _linked_pixels(labels, features.adjacency.right, features.adjacency.down, len(leaves) + 1)


@compiled
def _linked_pixels(labels: I32, right: Bool, down: Bool, size: int) -> tuple[Intp, Intp]:
    """List adjacent grid pixels of two labels, and the number of the pair."""
    height, width = labels.shape
    ends, pair_of, count = np.empty((2, 2 * labels.size), np.intp), np.empty(2 * labels.size, np.intp), 0
    for linked, below, beside in ((right, 0, 1), (down, 1, 0)):
        for r in range(height - below):
            for c in range(width - beside):
                one, other = labels[r, c], labels[r + below, c + beside]
                if one != other and linked[r, c]:
                    ends[0, count] = r * width + c
                    ends[1, count] = (r + below) * width + c + beside
                    pair_of[count] = min(one, other) * size + max(one, other)
                    count += 1
    return ends[:, :count].copy(), pair_of[:count].copy()


def _smoothness(
    pairs: list[_Pair], ends: NDArray[np.intp], pair_of: NDArray[np.intp], size: int, features: GridFeatures
) -> Iterator[tuple[int, float]]:
    """Yield the number of adjacent grid pixels of each pair, and the sum of cosines between their normals."""
    for one, other in pairs:
        own = ends[:, pair_of == one * size + other]
        first, second = np.split(features.normals(own.ravel()), 2)
        yield len(first), float(np.vdot(first, second))


def _judged(parts: list[Node], features: GridFeatures, config: SegmentationConfig) -> tuple[Node, Trial]:
    """Fit one surface to leaves, and judge a split of it into them."""
    (whole,) = nodes_of([features.fitter.of_union([part.fit for part in parts])], config)
    return whole, judge_split(whole.weighed(config), [part.weighed(config) for part in parts], config)


def _fold(
    root: Node,
    leaves: dict[int, Node],
    kept: int,
    gone: int,
    judged: tuple[Node, Trial],
    features: GridFeatures,
    config: SegmentationConfig,
) -> bool:
    """Merge two leaves; False, and nothing is changed, if a split above is not kept then."""
    before = [(node, _state(node)) for node in depth_first(root)]
    above, above_gone = _path(root, leaves[kept]), _path(root, leaves[gone])
    shared = sum(node is other for node, other in zip(above, above_gone, strict=False))
    moved = leaves[gone].grid_pixels
    for node in above[shared:]:
        node.grid_pixels = union((node.grid_pixels, moved))
    for node in above_gone[shared:-1]:
        node.grid_pixels = np.setdiff1d(node.grid_pixels, moved, assume_unique=True)
    whole, trial = judged
    leaves[kept].fit = whole.fit
    leaf_of = {id(leaf): number for number, leaf in leaves.items()}
    sibling, parent = remove_node(root, leaves[gone])
    at = {**leaves, **({leaf_of[id(sibling)]: parent} if id(sibling) in leaf_of else {})}

    leaf = at[kept]
    leaf.stop = whole.stop or stop_without_cut(leaf, 0, features.grid_pixels_min(config), config)
    leaf.trial = None if leaf.stop else trial
    leaf.stop, leaf.judged = leaf.stop or StopReason.CRITERION, None
    # The parent has the pixels of the sibling now, and is changed if that was.
    changed = {id(node) for node in (*above[shared:], *above_gone[shared:])} - {id(parent)}
    if parent is above[shared - 1]:
        changed.add(id(parent))
    judged_again = changed | {id(node) for node in above[:shared]}
    # Children before parents.
    for node in reversed(depth_first(root)):
        sound = True
        if not node.children:
            sound = node.stop is not StopReason.DEPTH or node.cuts_above >= config.depth_max
        elif node.division is not Division.CUT and id(node) in changed:
            node.fit = replace(node.fit, pixels=union([part.fit.pixels for part in node.children]))
        elif node.division is Division.CUT and id(node) in judged_again:
            if id(node) in changed or node.measured is not None:
                fits = [part.fit for part in leaves_below(node)]
                (node.grid_pixels, node.fit), node.measured = features.fitter.of_union(fits), None
            parts = [part.weighed(config) for part in _parts(node)]
            node.trial, node.judged = judge_split(node.weighed(config), parts, config), None
            sound = node.trial.kept
        if not sound:
            for changed_node, state in before:
                for name, value in zip(Node.__slots__, state, strict=True):
                    setattr(changed_node, name, value)
            return False
    leaves.update(at)
    del leaves[gone]
    if isinstance(leaf.memory, LeafMemory):
        # It was made with fewer points, and nothing of this frame shows it.
        leaf.memory.attempt = None
    return True


def _path(root: Node, leaf: Node) -> list[Node]:
    """Return the nodes from the root to a leaf, both included."""
    path = [root]
    while path[-1] is not leaf:
        path.append(next(child for child in path[-1].children if leaf.name.startswith(child.name)))
    return path


def _parts(node: Node) -> list[Node]:
    """Return the parts of a split: below nodes without a surface, which only chain components."""
    found, waiting = [], list(node.children)
    while waiting:
        part = waiting.pop(0)
        if part.division is Division.GAP:
            waiting[:0] = part.children
        else:
            found.append(part)
    return found
