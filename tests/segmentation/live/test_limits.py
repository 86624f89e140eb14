"""What the live tree may do and what it tells: limits, kinds of nodes, reasons, and when they were found."""

from dataclasses import replace

import numpy as np
import pytest
from designed_tree import CONFIG
from plates import PLATES, plates

from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.live import renewal
from nurbseg.segmentation.live import tree as tree_module
from nurbseg.segmentation.live.editor import UpdateReport
from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.live.updater import Budget
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Segment, SegmentationTree
from nurbseg.segmentation.surfaces.surface import evaluate
from nurbseg.segmentation.vocabulary import Division, StopReason

Seen = tuple[PointMap, SegmentationTree, UpdateReport]


def run(config: SegmentationConfig, frames: int = 12, first: int = 100, *, every: bool = False) -> list[Seen]:
    """A wall on which plates come out one after the other, with a thing before it for three frames."""
    live, seen = LiveTree(config), []
    for frame in range(frames):
        count = min(4, frame // 2)
        thing = (70, 50, 16, 20) if 4 <= frame <= 6 else None
        cloud = plates(*PLATES[:count], frame=frame, thing=thing)
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
    trees = [tree for _, tree, _ in run(CONFIG)]
    assert max(len(cuts_of(tree)) for tree in trees) > 2
    assert max(each.cuts_above for tree in trees for each in tree.segments) > 2


@pytest.mark.parametrize("most", [0, 1, 2])
def test_no_frame_has_deeper_cuts_than_the_depth_allows(most: int) -> None:
    reasons = set()
    for _, tree, _ in run(replace(CONFIG, depth_max=most)):
        for each in tree.segments:
            assert each.cuts_above == cuts_above(tree, each) <= most
            reasons.add(each.stop)
            if each.stop is StopReason.DEPTH:
                assert each.cuts_above == most
    assert StopReason.DEPTH in reasons


@pytest.mark.parametrize("most", [0, 1, 2])
def test_no_frame_has_more_cuts_than_splits_are_allowed(most: int) -> None:
    reasons, counts = set(), set()
    for _, tree, _ in run(replace(CONFIG, splits_max=most)):
        counts.add(len(cuts_of(tree)))
        reasons |= {each.stop for each in tree.leaves()}
        if any(each.stop is StopReason.SPLITS for each in tree.segments):
            assert len(cuts_of(tree)) == most
    assert max(counts) == most
    assert StopReason.SPLITS in reasons


def test_what_a_budget_of_time_left_is_cut_in_later_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    # Whatever waits is not segmented from scratch, which would end where it began.
    monkeypatch.setattr(tree_module, "_WAITING_MOST", -1)
    monkeypatch.setattr(tree_module, "_WAITING_FRAMES", 1)
    live = LiveTree(replace(CONFIG, budget_ms=1e-6))
    trees, resets = [], []
    for frame in range(12):
        trees.append(live.segment(plates(*PLATES[:3], frame=frame)))
        resets.append(bool(live.report.reset))
    assert resets == [True] + 11 * [False]
    assert {each.stop for each in trees[0].leaves()} == {StopReason.BUDGET}
    assert all(leaf.stop is not StopReason.BUDGET for tree in trees[1:] for leaf in tree.leaves())
    assert len(cuts_of(trees[-1])) > 2


def test_no_cut_has_a_ratio_of_t_or_more_and_a_smaller_t_keeps_fewer() -> None:
    counts = {}
    for most in (1.0, 0.9, 0.02):
        trees = [tree for _, tree, _ in run(replace(CONFIG, ratio_max=most))]
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
        trees = [tree for _, tree, _ in run(replace(CONFIG, metric=metric))]
        for tree in trees:
            for each in tree.segments:
                assert each.trial is None or each.trial.metric == metric
                if each.is_leaf:
                    assert metric in each.fit.values
        return sum(len(cuts_of(tree)) for tree in trees)

    # No residual is as large as 0.1 m: there is nothing that a split could better.
    assert cuts("nle") == 0
    assert cuts("mse") > 0


def test_what_comes_into_view_is_no_cut() -> None:
    live = LiveTree(CONFIG)
    live.segment(plates(frame=0), frame=7)
    tree = live.segment(plates(frame=1, thing=(70, 50, 16, 20)), frame=9)
    assert (live.report.appeared, live.report.splits) == (1, 0)
    root, rest, new = tree.segments
    assert (root.division, root.judged, root.trial, root.fit.surface) == (Division.APPEARED, 9, None, None)
    assert (rest.cuts_above, new.cuts_above) == (0, 0)
    assert new.pixels.size == pytest.approx(16 * 20, rel=0.1)


def test_only_reasons_that_were_found_are_given() -> None:
    seen = run(CONFIG)
    told = set()
    for place, (_, tree, _) in enumerate(seen):
        frame = 100 + place
        for leaf in tree.leaves():
            told.add(leaf.stop)
            # A rejected trial goes on to be told where the surface has come near to the noise since.
            assert leaf.stop is not StopReason.CRITERION or leaf.trial is not None
            assert leaf.stop is not StopReason.UNTRIED or leaf.trial is None
            if leaf.trial is not None:
                assert not leaf.trial.kept
                assert ratio_of("mse", (leaf.trial.value, leaf.trial.points), leaf.trial.parts) >= 1.0
            if place:
                assert leaf.measured == frame
                assert leaf.judged is not None
                assert 100 <= leaf.judged <= frame
            if leaf.stop in (StopReason.NOISE, StopReason.UNTRIED, StopReason.TOO_SMALL) and place:
                assert leaf.fit.surface is not None
            if leaf.stop is StopReason.UNTRIED:
                assert leaf.judged == frame
            if leaf.stop is StopReason.TOO_SMALL:
                # 1600 pixels of an image of 640 by 480 are 25 places here, 2 T_p is 50.
                assert leaf.fit.pixels.size <= 50
    assert {StopReason.CRITERION, StopReason.NOISE, StopReason.UNTRIED} <= told


def far_off(cloud: PointMap, segment: Segment) -> tuple[float, float]:
    """Root mean square distance to its surface of a segment's pixels, and of those it was measured on."""
    assert segment.fit.surface is not None
    width = cloud.valid.shape[1]
    squares = []
    for pixels in (segment.pixels, segment.fit.pixels):
        on_surface = evaluate(segment.fit.surface, pixels % width, pixels // width)
        squares.append(np.square(on_surface - cloud.points_m.reshape(-1, 3)[pixels]).sum(axis=1).mean())
    return float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))


@pytest.mark.parametrize("every", [False, True])
def test_surfaces_of_cut_segments_are_those_of_the_frame(
    every: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(renewal, "_JUDGED_PIXELS", 0)
    checked = without = 0
    for place, (cloud, tree, _) in enumerate(run(CONFIG, every=every)):
        for each in tree.segments:
            if each.fit.surface is None:
                without += each.division is Division.CUT
                if each.division is Division.CUT:
                    assert each.fit.reason == f"measured in frame {each.measured}"
                    assert each.measured is not None
                    assert each.measured < 100 + place
                continue
            on_all, on_measured = far_off(cloud, each)
            assert on_measured == pytest.approx(np.sqrt(each.fit.values["mse"]), rel=1e-3)
            # Noise at 1.4 m is 1 mm; a pixel beside a border may be of a plate, 40 mm off.
            assert on_all < 1.3 * on_measured + 2e-3
            if not each.is_leaf:
                checked += 1
                assert each.measured in (None, 100 + place)
                assert np.isin(each.fit.pixels, each.pixels).all()
    assert checked > 5
    assert (without == 0) == every


def test_every_surface_changes_no_label() -> None:
    for (_, one, _), (_, two, _) in zip(run(CONFIG), run(CONFIG, every=True), strict=True):
        assert np.array_equal(one.labels(), two.labels())
        assert [each.trial for each in one.segments] == [each.trial for each in two.segments]


def test_every_split_is_judged_again_within_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renewal, "_JUDGED_PIXELS", 0)
    seen = run(CONFIG, 30)
    assert max(len(cuts_of(tree)) for _, tree, _ in seen) > 2
    for place, (_, tree, report) in enumerate(seen):
        ages = [100 + place - each.judged for each in cuts_of(tree) if each.judged is not None]
        # One in each frame, the oldest first: none waits longer than there are others.
        assert max(ages, default=0) == report.oldest <= max(len(cuts_of(each)) for _, each, _ in seen)
    monkeypatch.setattr(renewal, "SPLIT_FRAMES", 1)
    for place, (_, tree, _) in enumerate(run(CONFIG)):
        assert all(each.judged is None or 100 + place - each.judged <= 1 for each in cuts_of(tree))


def test_trials_are_forgotten_within_their_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nurbseg.segmentation.live.updater.TRIAL_FRAMES", 6)
    ages = [
        100 + place - leaf.judged
        for place, (_, tree, _) in enumerate(run(replace(CONFIG, ratio_max=0.5), 30))
        for leaf in tree.leaves()
        if leaf.trial is not None and leaf.judged is not None
    ]
    assert 2 < max(ages) <= 6


def test_cuts_are_counted_where_parts_were_not_connected_at_first() -> None:
    live = LiveTree(replace(CONFIG, depth_max=1))
    thing = (70, 50, 16, 20)
    first = live.segment(plates(frame=0, thing=thing))
    assert [each.division for each in first.segments] == [Division.GAP, None, None]
    cuts = 0
    for frame in range(1, 10):
        tree = live.segment(plates(*PLATES[: frame // 2], frame=frame, thing=thing))
        assert all(each.cuts_above == cuts_above(tree, each) <= 1 for each in tree.segments)
        cuts = max(cuts, len(cuts_of(tree)))
    assert cuts == 1


def test_a_split_is_undone_by_its_own_ratio_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(renewal, "_JUDGED_PIXELS", 0)
    live = LiveTree(CONFIG)
    for frame in range(10):
        before = live.segment(plates(*PLATES[: frame // 2], frame=frame), Budget(merges=0))
        assert live.report.merges == 0
    count = len(cuts_of(before))
    assert count > 2
    # One split is judged in each frame, and undone in the next.
    for frame in range(10, 12 + count):
        flat = live.segment(plates(frame=frame), Budget(merges=0))
        assert all(each.trial is not None and each.trial.kept for each in cuts_of(flat))
    (wall,) = flat.segments
    assert wall.stop is StopReason.NOISE


@pytest.mark.parametrize("seed", range(5))
def test_splits_are_undone_where_one_surface_explains_their_parts_and_not_before(seed: int) -> None:
    live = LiveTree(replace(CONFIG, seed=seed))
    for frame in range(46):
        tree = live.segment(plates(*PLATES[: frame // 2], frame=frame))
        if frame >= 28:
            # Two plates and the wall beside them keep surfaces of their own.
            labels = tree.labels()
            parts = labels[26:40, 26:40], labels[30:44, 114:128], labels[:9]
            assert len({int(np.bincount(each.ravel()).argmax()) for each in parts}) == 3
            assert cuts_of(tree)
    merges = 0
    for frame in range(46, 50):
        tree = live.segment(plates(frame=frame))
        merges += live.report.merges
    assert merges > 0
    (wall_again,) = tree.segments
    assert wall_again.stop is StopReason.NOISE


def test_a_split_in_doubt_is_undone_only_if_fitted_surfaces_do_not_keep_it() -> None:
    live = LiveTree(CONFIG)
    cloud = plates(*PLATES[:2], frame=0)
    live.segment(cloud, frame=100)
    assert live._root.division is Division.CUT
    # As if surfaces that had moved no longer kept it: those fitted to the wall and its plates do.
    live._rejected = (live._root,)
    tree = live.segment(cloud, frame=101)
    assert tree.root.division is Division.CUT
    assert tree.root.trial is not None
    assert ratio_of("mse", (tree.root.trial.value, tree.root.trial.points), tree.root.trial.parts) < 0.9
