"""What the live tree may do and what it tells: limits, kinds of nodes, reasons, and when they were found."""

from dataclasses import replace

import numpy as np
import pytest
from plates import CONFIG, PLATES, plates, rising
from scipy import ndimage

from nurbseg.drivers.settings import updated
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.live.tree import LiveTree, UpdateReport
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.surface import evaluate
from nurbseg.segmentation.vocabulary import Division, StopReason

Seen = tuple[PointMap, SegmentationTree, UpdateReport]
#: Plates that come out of the wall are found by cuts alone.
CUTS = updated(CONFIG, extended={"protrusion_min": 0.0})
THING = (70, 50, 16, 20)
#: Pixels without a point.
HOLE = np.s_[100:112, 70:90]


def run(config: SegmentationConfig, frames: int = 24, first: int = 100, *, every: bool = False) -> list[Seen]:
    """A wall out of which plates come one after the other, with a thing before it for three frames."""
    live, seen = LiveTree(config), []
    for frame in range(frames):
        cloud = rising(frame, thing=THING if 12 <= frame <= 14 else None)
        points_m = cloud.points_m.copy()
        points_m[HOLE] = np.nan
        cloud = PointMap(points_m, cloud.color, cloud.colored)
        tree = live.segment(cloud, frame=first + frame, every_surface=every)
        assert bool(live.report.reset) == (frame == 0)
        seen.append((cloud, tree, live.report))
    return seen


def cuts_of(tree: SegmentationTree) -> list[Segment]:
    return [each for each in tree.segments if each.division is Division.CUT]


def cuts_above(tree: SegmentationTree, segment: Segment) -> int:
    """Count the cuts on the way to the root."""
    count = 0
    while segment.parent is not None:
        segment = tree[segment.parent]
        count += segment.division is Division.CUT
    return count


def ratio_of(metric: Metric, whole: tuple[float, int], parts: tuple[tuple[float, int], ...]) -> float:
    """Equation 5, or 13 and 22 for counts."""
    if metric in ("nle", "nlc"):
        return sum(value for value, _ in parts) / whole[0]
    return sum(value * points for value, points in parts) / (whole[0] * whole[1])


def test_without_limits_the_scene_is_cut_again_and_again() -> None:
    trees = [tree for _, tree, _ in run(CUTS)]
    assert max(len(cuts_of(tree)) for tree in trees) > 2
    assert max(each.cuts_above for tree in trees for each in tree.segments) > 2


@pytest.mark.parametrize("most", [0, 1, 2])
def test_no_frame_has_deeper_cuts_than_the_depth_allows(most: int) -> None:
    reasons = set()
    for _, tree, _ in run(replace(CUTS, depth_max=most)):
        for each in tree.segments:
            assert each.cuts_above == cuts_above(tree, each) <= most
            reasons.add(each.stop)
            if each.stop is StopReason.DEPTH:
                assert each.cuts_above == most
    assert StopReason.DEPTH in reasons


@pytest.mark.parametrize("most", [0, 1, 2])
def test_no_frame_has_more_cuts_than_splits_are_allowed(most: int) -> None:
    reasons, counts = set(), set()
    for _, tree, _ in run(replace(CUTS, splits_max=most)):
        counts.add(len(cuts_of(tree)))
        reasons |= {each.stop for each in tree.leaves()}
        if any(each.stop is StopReason.SPLITS for each in tree.segments):
            assert len(cuts_of(tree)) == most
    assert max(counts) == most
    assert StopReason.SPLITS in reasons


def test_no_cut_has_a_ratio_of_t_or_more_and_a_smaller_t_keeps_fewer() -> None:
    counts = {}
    for most in (1.0, 0.9, 0.02):
        trees = [tree for _, tree, _ in run(replace(CUTS, ratio_max=most))]
        for tree in trees:
            for each in cuts_of(tree):
                assert each.trial is not None
                assert each.trial.kept
                whole = each.trial.value, each.trial.points
                assert ratio_of("mse", whole, each.trial.parts) < most
        counts[most] = sum(len(cuts_of(tree)) for tree in trees)
    assert counts[1.0] > counts[0.9] > counts[0.02] == 0


def test_the_metric_decides() -> None:
    def cuts(metric: Metric) -> int:
        trees = [tree for _, tree, _ in run(replace(CUTS, metric=metric))]
        for tree in trees:
            for each in tree.segments:
                assert each.trial is None or each.trial.metric == metric
                if each.is_leaf:
                    assert metric in each.fit.values
        return sum(len(cuts_of(tree)) for tree in trees)

    # No residual is as large as 0.1 m: there is nothing that a split could better.
    assert cuts("nle") == 0
    assert cuts("mse") > 0


def far_off(cloud: PointMap, segment: Segment) -> tuple[float, float]:
    """Root mean square distance to its surface of a segment's pixels, and of those it was measured on."""
    assert segment.fit.surface is not None
    width = cloud.valid.shape[1]
    squares = []
    for pixels in (segment.pixels, segment.fit.pixels):
        on_surface = evaluate(segment.fit.surface, pixels % width, pixels // width)
        squares.append(np.square(on_surface - cloud.points_m.reshape(-1, 3)[pixels]).sum(axis=1).mean())
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))


@pytest.mark.parametrize("config", [CONFIG, CUTS])
def test_every_tree_is_whole(config: SegmentationConfig) -> None:
    for cloud, tree, _ in run(config):
        names = [each.name for each in tree.segments]
        assert len(set(names)) == len(names)
        covered = np.zeros(cloud.valid.size, dtype=int)
        for each in tree.segments:
            assert (each.stop is None) == bool(each.children)
            assert (each.division is None) == (not each.children)
            if each.children:
                assert each.children == (f"{each.name}0", f"{each.name}1")
                below = np.concatenate([tree[child].pixels for child in each.children])
                assert np.array_equal(np.sort(below), np.sort(each.pixels))
            else:
                covered[each.pixels] += 1
        # Leaves are on all pixels with a point, and on no others.
        assert np.array_equal(covered.reshape(cloud.valid.shape), cloud.valid)
        assert np.array_equal(tree.labels() > 0, cloud.valid)


@pytest.mark.parametrize("config", [CONFIG, CUTS])
def test_leaves_are_connected_but_for_specks(config: SegmentationConfig) -> None:
    for _, tree, _ in run(config):
        for label in range(1, len(tree.leaves()) + 1):
            parts = ndimage.label(tree.labels() == label, np.ones((3, 3)))[0]
            sizes = np.sort(np.bincount(parts.ravel())[1:])
            # T_p is 100 pixels of an image of this size; what is cut off is a leaf from four times that on.
            assert sizes[:-1].max(initial=0) < 400


def test_what_a_budget_of_time_left_is_cut_in_later_frames() -> None:
    live = LiveTree(replace(CUTS, budget_ms=1e-6))
    first = live.segment(plates(*PLATES[:3], frame=0))
    assert {each.stop for each in first.leaves()} == {StopReason.BUDGET}
    # There is no time in any frame: the tree is still that of the one before.
    again = live.segment(plates(*PLATES[:3], frame=1))
    assert live.report.reset == ""
    assert {each.stop for each in again.leaves()} == {StopReason.BUDGET}
