"""Cuts of the default method, seen in the tree of a frame: where they run and what they leave."""

import numpy as np
import pytest

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.vocabulary import Division, StopReason

#: Cuts alone, with no floor of noise.
CONFIG = SegmentationConfig(
    decimation=1,
    ratio_max=0.5,
    extended=ExtendedConfig(
        piece_pixels_min=2000,
        inverse_depth_noise=1e-6,
        noise_floor=0.0,
        cuts=5,
        fold_surfaces=False,
        split_creases=False,
        protrusion_min=0.0,
        refine_borders=False,
    ),
)


def roof(cloud_of, size, config=CONFIG):
    """Segment two slopes that meet in a ridge down the middle, with some noise."""
    columns = np.mgrid[: size[0], : size[1]][1]
    noise = 1e-4 * np.random.default_rng(0).standard_normal(size)
    middle = (size[1] - 1) / 2
    return segment(cloud_of(1.0 / (0.9 - 0.01 * np.abs(columns - middle) + noise)), config)


# A segment of 2,000 grid pixels or more is cut on every second row and column, and the cut continued.
@pytest.mark.parametrize(("size", "share"), [((36, 48), 1), ((48, 64), 4)])
def test_a_roof_is_cut_at_its_ridge(cloud_of, size, share):
    tree = roof(cloud_of, size)
    root = tree.root
    assert (root.division, root.stop, root.cuts_above) == (Division.CUT, None, 0)
    assert root.cut.side.size == size[0] * size[1] / share
    assert root.trial.kept
    assert root.trial.points == size[0] * size[1]
    for name in root.children:
        left = np.mean(tree[name].pixels % size[1] < size[1] / 2)
        assert max(left, 1 - left) > 0.98
        assert (tree[name].stop, tree[name].cuts_above) == (StopReason.CRITERION, 1)
    # The second eigenvector is enough: the cuts after it are not tried.
    one = roof(cloud_of, size, updated(CONFIG, extended={"cuts": 1}))
    assert np.array_equal(one.labels("surfaces"), tree.labels("surfaces"))


def test_the_best_of_several_rejected_cuts_is_reported(cloud_of):
    judged = []
    rows, columns = np.mgrid[:48, :64]
    dome = 0.9 + 2e-4 * (rows - 20.0) ** 2 + 1e-4 * (columns - 30.0) ** 2
    tree = segment(cloud_of(1.0 / dome), updated(CONFIG, ratio_max=1e-9), observe=judged.append)
    (root,) = tree.segments
    assert root.stop is StopReason.CRITERION
    assert len(judged) > 2
    ratios = [each.trial.ratio for each in judged]
    assert root.ratio == min(ratios) < max(ratios)
    assert ratios.index(min(ratios)) > 0 or ratios.index(max(ratios)) > 0
    assert not any(each.trial.kept for each in judged)


def below(tree: SegmentationTree, name: str) -> list[int]:
    """Sizes of the leaves of a chain of parts that are not connected."""
    node = tree[name]
    if node.division is not Division.GAP:
        return [node.fit.pixels.size]
    return [size for child in node.children for size in below(tree, child)]


def test_parts_that_are_not_connected_are_chained_the_largest_first(cloud_of):
    depth = np.full((48, 64), 1.0)
    depth[:, 12:40], depth[:, 40:] = 2.0, 3.0
    tree = segment(cloud_of(depth), CONFIG)
    assert below(tree, "") == [48 * 28, 48 * 24, 48 * 12]
    assert [(each.name, each.cuts_above) for each in tree.segments] == [
        (name, 0) for name in ("", "0", "1", "10", "11")
    ]
    assert "3 components that are not connected" in tree.root.fit.reason
    assert "2 components" in tree["1"].fit.reason


def test_a_part_of_a_cut_that_is_not_connected_is_a_chain(cloud_of, box_on_table):
    """The table is on three sides of the box; cuts of a frame that noise tears have many parts."""
    chains = 0
    for seed in range(4):
        cloud = cloud_of(box_on_table((96, 128), noise_per_m=4e-3, seed=seed)[0])
        config = updated(CONFIG, ratio_max=1.0, extended={"piece_pixels_min": 400, "inverse_depth_gap": 1.0})
        tree = segment(cloud, config)
        for each in tree.segments:
            parent = each.parent if each.parent is None else tree[each.parent]
            if each.division is not Division.GAP or parent is None or parent.division is not Division.CUT:
                continue
            sizes = below(tree, each.name)
            chains += len(sizes) > 2
            assert sizes == sorted(sizes, reverse=True)
            assert sum(sizes) == each.fit.pixels.size
            assert f"{len(sizes)} components" in each.fit.reason
            assert (each.trial, each.cut) == (None, None)
            assert {tree[child].cuts_above for child in each.children} == {each.cuts_above}
    assert chains > 0
