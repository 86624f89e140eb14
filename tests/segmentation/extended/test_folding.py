"""Leaves of different branches become one where they meet smoothly and one surface explains both."""

from dataclasses import replace

import numpy as np
import pytest
from rendered import rendered

from nurbseg.common.settings import updated
from nurbseg.drivers.registry import open_source
from nurbseg.evaluation.scoring.regions import Contingency
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended import folding
from nurbseg.segmentation.extended.folding import fold_leaves
from nurbseg.segmentation.extended.grid_features import grid_features
from nurbseg.segmentation.extended.memory import Attempt, LeafMemory
from nurbseg.segmentation.extended.parts import chain_components, fit_segment, judge_split
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import register
from nurbseg.segmentation.segments import Node, depth_first, leaves_below
from nurbseg.segmentation.vocabulary import Division, StopReason

CONFIG = SegmentationConfig(decimation=1)
SIZE = (120, 160)
NOISE_PER_M = 2e-3


def node_of(name, inside, features, config):
    part = fit_segment(features, np.flatnonzero(inside), config)
    return Node(name, part.grid_pixels, part.fit, stop=part.stop, cuts_above=len(name))


class ParedWall:
    """A wall whose right part, 1, is cut off first, then a wedge, 01, that stands out at its lower left.

    The left part of a `broken` wedge is steeper, and is cut off the wall last: 001.
    """

    def __init__(self, cloud_of, config=CONFIG, *, broken=False, middle=80):
        rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
        self.block = (rows >= 60) & (columns < 60)
        steep = self.block & (columns < (30 if broken else 0))
        inverse_depth = 1.0 + np.where(steep, 0.03, 0.01) * np.where(self.block, rows - 60.0, 0.0)
        noise = NOISE_PER_M * np.random.default_rng(0).standard_normal(SIZE)
        self.features = grid_features(cloud_of(1 / (inverse_depth + noise)), config)
        right = columns >= middle
        inside = {
            "": np.ones(SIZE, bool),
            "0": ~right,
            "00": ~right & (steep | ~self.block),
            "01": self.block & ~steep,
            "1": right,
        }
        if broken:
            inside |= {"000": ~right & ~self.block, "001": steep}
        nodes = {name: node_of(name, own, self.features, config) for name, own in inside.items()}
        self.root = nodes[""]
        for name, node in nodes.items():
            if f"{name}0" not in nodes:
                continue
            parts = nodes[f"{name}0"], nodes[f"{name}1"]
            node.children, node.division, node.stop = parts, Division.CUT, None
            weighed = [(part.value(config), part.grid_pixels.size) for part in parts]
            node.trial = judge_split((node.value(config), node.grid_pixels.size), weighed, config)

    def leaves(self):
        return {node.name: node for node in depth_first(self.root) if not node.children}


@pytest.mark.parametrize("middle", [80, 100], ids=["into the right", "into the left"])
def test_the_halves_of_a_wall_become_one_leaf(cloud_of, middle):
    scene = ParedWall(cloud_of, middle=middle)
    before = scene.root.fit
    fold_leaves(scene.root, scene.features, CONFIG)
    leaves = scene.leaves()
    assert sorted(leaves) == ["0", "1"]
    (wall,) = (leaf for leaf in leaves.values() if leaf.grid_pixels[0] == 0)
    assert np.array_equal(wall.grid_pixels, np.flatnonzero(~scene.block))
    # Of all of it nothing new was to be fitted, but that is compared with its new parts.
    assert np.allclose(scene.root.fit.residuals_m, before.residuals_m)
    whole, *parts = ((node.value(CONFIG), node.grid_pixels.size) for node in depth_first(scene.root))
    assert scene.root.trial == judge_split(whole, parts, CONFIG)
    assert scene.root.trial.kept
    again = fit_segment(scene.features, wall.grid_pixels, CONFIG)
    assert np.array_equal(wall.fit.residuals_m, again.fit.residuals_m)
    assert (wall.stop, wall.trial) == (StopReason.NOISE, None)
    assert [node.cuts_above for node in depth_first(scene.root)] == [0, 1, 1]


def test_what_was_tried_of_a_leaf_is_forgotten_when_it_grows(cloud_of):
    scene = ParedWall(cloud_of, middle=80)
    for leaf in scene.leaves().values():
        leaf.memory = LeafMemory(0)
        leaf.memory.attempt = Attempt(StopReason.CRITERION, None, 0, 0.0, leaf.grid_pixels.size)
    fold_leaves(scene.root, scene.features, CONFIG)
    block, wall = sorted(scene.leaves().values(), key=lambda leaf: leaf.grid_pixels.size)
    assert block.memory.attempt is not None
    assert wall.memory.attempt is None


@pytest.mark.parametrize(("new_leaf", "count"), [("beside both", 2), ("between them", 1)])
def test_old_leaves_that_met_before_stay_apart_when_one_takes_a_new_one(cloud_of, new_leaf, count):
    # A wall in three leaves: two old ones, and one that was split off, beside both or over all their border.
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    noise = NOISE_PER_M * np.random.default_rng(0).standard_normal(SIZE)
    features = grid_features(cloud_of(1 / (1.0 + noise)), CONFIG)
    new = (abs(columns - 80) < 10) & (rows >= (100 if new_leaf == "beside both" else 0))
    left_of = columns < 80
    parts = [node_of("", inside, features, CONFIG) for inside in (~new & left_of, ~new & ~left_of, new)]
    root, old = chain_components("", parts, 0), parts[:2]
    fold_leaves(root, features, CONFIG, lambda one, other: not (one in old and other in old))
    assert len(leaves_below(root)) == count


def test_segments_lose_what_a_leaf_far_below_them_gives_away(cloud_of):
    scene = ParedWall(cloud_of, broken=True)
    fold_leaves(scene.root, scene.features, CONFIG)
    (wedge,) = (node for node in scene.root.children if node.children)
    assert np.array_equal(wedge.grid_pixels, np.flatnonzero(scene.block))
    again = fit_segment(scene.features, np.flatnonzero(scene.block), CONFIG)
    assert np.array_equal(wedge.fit.residuals_m, again.fit.residuals_m)
    assert sorted(leaf.grid_pixels.size for leaf in wedge.children) == [1800, 1800]


def test_without_a_floor_the_ratio_decides(cloud_of):
    # Without a floor the ratio alone decides; one of 0.9 or more keeps nothing apart.
    config = updated(CONFIG, ratio_max=0.9, extended={"noise_floor": 0.0})
    scene = ParedWall(cloud_of, config)
    parts = [
        (leaf.value(config), leaf.grid_pixels.size) for name, leaf in scene.leaves().items() if name != "01"
    ]
    fold_leaves(scene.root, scene.features, config)
    (wall,) = (leaf for leaf in scene.leaves().values() if leaf.grid_pixels[0] == 0)
    assert wall.stop is StopReason.CRITERION
    assert wall.trial == judge_split((wall.value(config), wall.grid_pixels.size), wall.trial.parts, config)
    assert sorted(wall.trial.parts) == sorted(parts)
    assert wall.trial.ratio >= 0.9


def state(root):
    return [(node, *(getattr(node, name) for name in Node.__slots__)) for node in depth_first(root)]


def same(one, other):
    return len(one) == len(other) and all(
        all(a is b or (np.isscalar(a) and a == b) for a, b in zip(first, second, strict=True))
        for first, second in zip(one, other, strict=True)
    )


def test_nothing_changes_where_a_split_above_would_be_kept_no_longer(cloud_of, monkeypatch):
    scene = ParedWall(cloud_of)
    before = state(scene.root)
    judge = folding.judge_split

    def judge_above(whole, parts, config):
        # Whatever is judged of the whole frame is rejected.
        trial = judge(whole, parts, config)
        return replace(trial, kept=False) if whole[1] == SIZE[0] * SIZE[1] else trial

    monkeypatch.setattr(folding, "judge_split", judge_above)
    fold_leaves(scene.root, scene.features, CONFIG)
    assert same(state(scene.root), before)


@pytest.mark.parametrize("reason", [StopReason.SPLITS, StopReason.BUDGET, StopReason.DEPTH])
def test_a_tree_that_a_limit_stopped_stays_as_it_is(cloud_of, reason):
    scene = ParedWall(cloud_of)
    config = replace(CONFIG, depth_max=2)
    scene.leaves()["01"].stop = reason
    before = state(scene.root)
    fold_leaves(scene.root, scene.features, config)
    # A leaf that was as deep as it may be would be less deep.
    assert same(state(scene.root), before)


def test_leaves_meet_along_places_with_the_cosines_of_their_normals(cloud_of):
    scene = ParedWall(cloud_of)
    leaves = dict(enumerate(scene.leaves().values(), start=1))
    labels = np.zeros(SIZE, int)
    for number, leaf in leaves.items():
        labels.flat[leaf.grid_pixels] = number
    normals = scene.features.raw[:, 6:].reshape(*SIZE, 3).astype(float)
    expected = {}
    for row, column in np.ndindex(SIZE):
        for down, across, joined in (
            (0, 1, scene.features.adjacency.right),
            (1, 0, scene.features.adjacency.down),
        ):
            if not joined[row, column] or labels[row, column] == labels[row + down, column + across]:
                continue
            pair = tuple(sorted((labels[row, column], labels[row + down, column + across])))
            cosine = normals[row, column] @ normals[row + down, column + across]
            places, cosines = expected.get(pair, (0, 0.0))
            expected[pair] = places + 1, cosines + cosine
    found = folding._borders(leaves, scene.features)
    assert set(found) == set(expected)
    for pair, (places, cosines) in expected.items():
        assert found[pair] == (places, pytest.approx(cosines, rel=1e-5))


def test_the_pair_with_the_largest_ratio_comes_first_as_its_leaves_are_now(monkeypatch):
    with open_source(rendered("frames=1&labels=surfaces&seed=0")) as source:
        cloud = register(source.read())
    merged, merge = [], folding._fold

    def check_merge(root, leaves, kept, gone, judged, features, config):
        whole, trial = judged
        now = np.union1d(leaves[kept].grid_pixels, leaves[gone].grid_pixels)
        assert np.array_equal(whole.grid_pixels, now)
        if not merged:
            smooth = [
                [leaves[number] for number in pair]
                for pair, (count, cosines) in folding._borders(leaves, features).items()
                if count >= 4 and cosines > 0.966 * count
            ]
            ratios = [folding._judged(pair, features, config)[1].ratio for pair in smooth]
            assert trial.ratio == max(ratios) > np.median(ratios)
        merged.append(trial.ratio)
        return merge(root, leaves, kept, gone, judged, features, config)

    monkeypatch.setattr(folding, "_fold", check_merge)
    config = SegmentationConfig(metric="vmxc", ratio_max=0.8, seed=3)
    segment(cloud, updated(config, extended={"inverse_depth_noise": 2.5e-3}))
    assert len(merged) > 3


def test_a_table_that_the_first_cuts_tear_is_one_surface():
    with open_source(rendered("frames=1&labels=surfaces&seed=0")) as source:
        frame = source.read()
    cloud, torn = register(frame), updated(SegmentationConfig(), extended={"fold_surfaces": False})
    tables = [
        Contingency.between(segment(cloud, config).labels("surfaces"), np.minimum(frame.labels, 2))
        for config in (SegmentationConfig(), torn)
    ]
    folded, apart = (table.pixels[:, 0] for table in tables)
    assert folded.max() > 0.97 * folded.sum()
    assert apart.max() < 0.9 * apart.sum()
