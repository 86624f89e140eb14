"""What the live tree may do and what it tells: limits, kinds of nodes, reasons, and when they were found."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from plates import CONFIG, PLATES, plates, rising
from scipy import ndimage
from sound_tree import assert_sound

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.extended import memory
from nurbseg.segmentation.live import question
from nurbseg.segmentation.live.tree import UNLIMITED, Budget, LiveTree, UpdateReport
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
    return [segment for segment in tree.segments if segment.division is Division.CUT]


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
    assert max(segment.cuts_above for tree in trees for segment in tree.segments) > 2


@pytest.mark.parametrize("most", [0, 1, 2])
def test_no_frame_has_deeper_cuts_than_the_depth_allows(most: int) -> None:
    reasons = set()
    for _, tree, _ in run(replace(CUTS, depth_max=most)):
        for segment in tree.segments:
            assert segment.cuts_above == cuts_above(tree, segment) <= most
            reasons.add(segment.stop)
            if segment.stop is StopReason.DEPTH:
                assert segment.cuts_above == most
    assert StopReason.DEPTH in reasons


@pytest.mark.parametrize("most", [0, 1, 2])
def test_no_frame_has_more_cuts_than_splits_are_allowed(most: int) -> None:
    reasons, counts = set(), set()
    for _, tree, _ in run(replace(CUTS, splits_max=most)):
        counts.add(len(cuts_of(tree)))
        reasons |= {leaf.stop for leaf in tree.leaves()}
        if any(segment.stop is StopReason.SPLITS for segment in tree.segments):
            assert len(cuts_of(tree)) == most
    assert max(counts) == most
    assert StopReason.SPLITS in reasons


def test_no_cut_has_a_ratio_of_t_or_more_and_a_smaller_t_keeps_fewer() -> None:
    counts = {}
    for most in (1.0, 0.95, 0.02):
        trees = [tree for _, tree, _ in run(replace(CUTS, ratio_max=most))]
        for tree in trees:
            for cut in cuts_of(tree):
                assert cut.trial is not None
                assert cut.trial.kept
                whole = cut.trial.value, cut.trial.points
                assert ratio_of("mse", whole, cut.trial.parts) < most
        counts[most] = sum(len(cuts_of(tree)) for tree in trees)
    assert counts[1.0] > counts[0.95] > counts[0.02] == 0


def test_the_metric_decides() -> None:
    def cuts(metric: Metric) -> int:
        trees = [tree for _, tree, _ in run(replace(CUTS, metric=metric))]
        for tree in trees:
            for segment in tree.segments:
                assert segment.trial is None or segment.trial.metric == metric
                if segment.is_leaf:
                    assert metric in segment.fit.values
        return sum(len(cuts_of(tree)) for tree in trees)

    # No residual is as large as 0.1 m: there is nothing that a split could better.
    assert cuts("nle") == 0
    assert cuts("mse") > 0


def far_off(cloud: PointMap, segment: Segment) -> tuple[float, float]:
    """Distances to its surface: median of a segment's pixels, root mean square of those it was fitted to."""
    assert segment.fit.surface is not None
    width = cloud.valid.shape[1]

    def squares(pixels: NDArray[np.intp]) -> NDArray[np.float64]:
        on_surface = evaluate(segment.fit.surface, pixels % width, pixels // width)
        return np.square(on_surface - cloud.points_m.reshape(-1, 3)[pixels]).sum(axis=1)

    median, mean = np.median(squares(segment.pixels)), squares(segment.fit.pixels).mean()
    return float(np.sqrt(median)), float(np.sqrt(mean))


@pytest.mark.parametrize("config", [CONFIG, CUTS])
def test_every_tree_is_sound(config: SegmentationConfig) -> None:
    for cloud, tree, _ in run(config):
        assert_sound(tree, cloud.valid)


def test_leaves_are_connected_on_the_grid_but_for_what_is_too_small_for_one() -> None:
    for frame in range(24):
        live = LiveTree(updated(CUTS, extended={"refine_borders": False}))
        live.segment(rising(0))
        # Something in front of all rows or columns cuts off what is on its other side.
        thing = ((frame * 5, 0, 12, 120), (0, frame * 4, 160, 8))[frame % 2]
        for noise in range(2):
            labels = live.segment(rising(0, noise + 1, thing)).labels()[::2, ::2]
            assert live.report.reset == ""
            for label in range(1, int(labels.max()) + 1):
                parts = ndimage.label(labels == label, np.ones((3, 3)))[0]
                sizes = np.sort(np.bincount(parts.ravel())[1:])
                # T_p is 25 pixels of this grid; a part that is cut off is a leaf from four times that on.
                assert sizes[:-1].max(initial=0) < 100


def test_without_time_a_tree_is_continued_and_says_so() -> None:
    live = LiveTree(replace(CUTS, budget_ms=1e-6))
    first = live.segment(plates(*PLATES[:3], frame=0))
    assert {leaf.stop for leaf in first.leaves()} == {StopReason.BUDGET}
    # There is no time in any frame: the tree is still that of the one before.
    again = live.segment(plates(*PLATES[:3], frame=1))
    assert live.report.reset == ""
    assert {leaf.stop for leaf in again.leaves()} == {StopReason.BUDGET}


def test_a_budget_of_nothing_leaves_a_fitted_leaf_on_every_pixel_that_is_pending() -> None:
    live = LiveTree(CUTS)
    live.segment(rising(0))
    for frame in range(1, 5):
        cloud = rising(frame, thing=THING)
        tree = live.segment(cloud, Budget(trials=0, judged_pixels=0))
        assert live.report.trials == live.report.splits == 0
        assert np.array_equal(tree.labels() > 0, cloud.valid)
        assert all(leaf.fit.surface is not None and leaf.measured is None for leaf in tree.leaves())
    # The plate is further out than noise explains; the wall waits for its turn.
    waiting = [leaf for leaf in tree.leaves() if leaf.stop is StopReason.PENDING]
    assert live.report.waiting == len(waiting) == 1
    tree = live.segment(rising(4, 9, THING), UNLIMITED)
    assert live.report.waiting == 0
    assert live.report.trials == 1
    assert all(leaf.stop is not StopReason.PENDING for leaf in tree.leaves())


@pytest.mark.parametrize("trials", [0, 1, 2])
def test_no_more_leaves_are_cut_than_the_budget_allows(trials: int) -> None:
    live, most = LiveTree(CUTS), 0
    for frame in range(12):
        tree = live.segment(rising(frame), Budget(trials=trials))
        if not live.report.reset:
            most = max(most, live.report.trials)
        assert live.report.waiting == sum(leaf.stop is StopReason.PENDING for leaf in tree.leaves())
    assert most == trials


def test_what_comes_into_view_is_no_cut() -> None:
    live = LiveTree(CONFIG)
    live.segment(plates(frame=0), frame=7)
    tree = live.segment(plates(frame=1, thing=THING), frame=9)
    assert (live.report.appeared, live.report.splits) == (1, 0)
    root, rest, new = tree.segments
    assert (root.division, root.trial, root.fit.surface) == (Division.APPEARED, None, None)
    assert (rest.cuts_above, new.cuts_above) == (0, 0)
    assert new.pixels.size == pytest.approx(THING[2] * THING[3], rel=0.1)


@pytest.mark.parametrize("every", [False, True])
def test_surfaces_of_cut_segments_are_those_of_the_frame(every: bool) -> None:
    budget, checked, without = Budget(judged_pixels=0), 0, 0
    live = LiveTree(CUTS)
    for frame in range(100, 124):
        cloud = rising(frame - 100)
        tree = live.segment(cloud, budget, frame=frame, every_surface=every)
        for segment in tree.segments:
            if segment.fit.surface is None:
                if segment.division is Division.CUT:
                    without += 1
                    assert segment.fit.reason == f"measured in frame {segment.measured}"
                    assert segment.measured is not None
                    assert segment.measured < frame
                continue
            on_most, on_measured = far_off(cloud, segment)
            assert on_measured == pytest.approx(np.sqrt(segment.fit.values["mse"]), rel=1e-3)
            # Noise at 1.4 m is 1 mm.
            assert on_most < 1.3 * on_measured + 2e-3
            if not segment.is_leaf:
                checked += 1
                assert segment.measured in (None, frame)
    assert checked > 5
    assert (without == 0) == every


def test_every_surface_changes_no_label() -> None:
    one, two = LiveTree(CUTS), LiveTree(CUTS)
    for frame in range(24):
        tree = one.segment(rising(frame), Budget(judged_pixels=0))
        same = two.segment(rising(frame), Budget(judged_pixels=0), every_surface=True)
        assert np.array_equal(tree.labels(), same.labels())
        assert [segment.name for segment in tree.segments] == [segment.name for segment in same.segments]


def judged_in_turn(frames: int) -> Iterator[tuple[int, int, list[int]]]:
    """Numbers of cuts and of those judged, and frames since each was, where there is room for none."""
    live = LiveTree(CUTS)
    for frame in range(frames):
        tree = live.segment(rising(frame), Budget(judged_pixels=0), frame=frame)
        ages = [frame - cut.judged for cut in cuts_of(tree) if cut.judged is not None]
        yield len(cuts_of(tree)), live.report.judged, ages


def test_every_cut_is_judged_in_turn_and_within_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    counts, judged, ages = zip(*judged_in_turn(30), strict=True)
    assert max(counts) > 2
    # One in each frame nevertheless, and none is forgotten.
    assert list(judged) == [0, *(min(1, count) for count in counts[:-1])]
    assert 2 < max(max(age, default=0) for age in ages) < 20
    monkeypatch.setattr(question, "SPLIT_FRAMES", 1)
    for _, _, each in judged_in_turn(24):
        assert max(each, default=0) <= 1


def test_trials_are_made_again_within_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "TRIAL_FRAMES", 6)
    live, ages = LiveTree(replace(CUTS, ratio_max=0.5)), []
    for frame in range(30):
        tree = live.segment(rising(min(frame, 8), frame), frame=frame)
        ages += [frame - leaf.judged for leaf in tree.leaves() if leaf.trial and leaf.judged is not None]
    assert 2 < max(ages) <= 6


def test_cuts_are_counted_where_parts_were_not_connected_at_first() -> None:
    live, cuts = LiveTree(replace(CUTS, depth_max=1)), 0
    first = live.segment(rising(0, thing=THING))
    assert [segment.division for segment in first.segments] == [Division.GAP, None, None]
    for frame in range(1, 12):
        tree = live.segment(rising(frame, thing=THING))
        assert all(segment.cuts_above == cuts_above(tree, segment) <= 1 for segment in tree.segments)
        cuts = max(cuts, len(cuts_of(tree)))
    assert cuts == 1
