"""Whether each split follows from the settings, the sizes and the values (eq. 5)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedSegment, Finding, Measured

#: Sums of a few numbers in double precision agree to this, whatever their order.
_ROUNDING = 1e-12
#: How segments of a live tree may fall into their children.
_LIVE_KINDS = ("cut", "gap", "appeared")


def ratio_of(metric: str, whole: Measured, parts: Iterable[Measured]) -> float:
    """Return the metric of the parts over that of the whole (eq. 5; eq. 13 and 22 for counts).

    What was not measured counts as 0; inf where the whole's value is 0.
    """
    value, points = whole.value or 0.0, whole.points
    counted = metric in ("nle", "nlc")
    after = math.fsum((part or 0.0) * (1 if counted else size) for part, size in parts)
    before = value * (1 if counted else points)
    return after / before if before > 0 else math.inf


def check_splits(frame: ExportedFrame) -> Iterator[Finding]:
    """Recompute every ratio, and check splits against T, T_d, T_s and T_p."""
    tree, config, step = frame.tree_file, frame.settings.config, frame.step
    points, on_grid = frame.points_below("P"), np.count_nonzero(frame.leaf_image[::step, ::step])
    if points != on_grid:
        expected = f"{on_grid} in all leaves, the pixels with a label of every {step} rows and columns"
        yield Finding(tree, "P", "points", expected, str(points))
    if frame.tree.metric != config.metric:
        yield Finding(tree, "", "metric", config.metric, frame.tree.metric)
    for name, each in frame.segments.items():
        kinds = (("cut", "gap") if frame.settings.independent else _LIVE_KINDS) if each.children else (None,)
        if each.division not in kinds:
            yield Finding(tree, name, "division", " or ".join(map(str, kinds)), str(each.division))
        if (each.stop is None) != bool(each.children):
            yield Finding(tree, name, "stop", "a reason for leaves alone", str(each.stop))
        if each.value != each.values.get(frame.tree.metric):
            yield Finding(tree, name, "value", str(each.values.get(frame.tree.metric)), str(each.value))
        # What a live tree holds together without a cut has no points of its own.
        own = each.division == "cut" or frame.settings.independent
        if own and each.measured == frame.number and each.points != frame.points_below(name):
            expected = f"{frame.points_below(name)}, the sum of its leaves"
            yield Finding(tree, name, "points", expected, str(each.points))
        if each.division in ("gap", "appeared"):
            if each.trial is not None or each.surface:
                yield Finding(tree, name, "division", "no trial and no surface without a cut", "one of them")
            if config.method == "stag15":
                yield Finding(tree, name, "division", "cut: stag15 knows no gaps", "gap")
        yield from _check_trial(frame, each)
    cuts = [each.name for each in frame.segments.values() if each.division == "cut"]
    if len(cuts) > config.splits_max:
        yield Finding(tree, "", "splits", f"at most {config.splits_max} (T_s)", str(len(cuts)))
    for name in cuts:
        if frame.cuts_above(name) >= config.depth_max:
            depth = f"{frame.cuts_above(name) + 1} splits above its parts"
            yield Finding(tree, name, "depth", f"at most {config.depth_max} (T_d)", depth)


def _check_trial(frame: ExportedFrame, each: ExportedSegment) -> Iterator[Finding]:
    """Check a trial against its own ratio, the segment and, if it was kept, its parts."""
    tree, name, trial, settings = frame.tree_file, each.name, each.trial, frame.settings
    if each.division == "cut" and (trial is None or not trial.kept):
        yield Finding(tree, name, "trial", "the one that was kept", str(trial))
    if trial is None:
        if each.ratio is not None:
            yield Finding(tree, name, "ratio", "None, nothing was tried", str(each.ratio))
        return
    if trial.metric != frame.tree.metric:
        yield Finding(tree, name, "trial metric", frame.tree.metric, trial.metric)
    ratio = ratio_of(trial.metric, trial.whole, trial.parts)
    yield from _compare_ratio(tree, name, "of the trial", ratio, each.ratio)
    # A live tree's labels may still change in the frame of a trial.
    same_points = not settings.temporal or trial.whole[1] == each.points
    if each.judged == each.measured and same_points and trial.whole != (each.counted, each.points):
        yield Finding(tree, name, "trial", f"value and points {each.counted, each.points}", str(trial.whole))
    below = [points for _, points in trial.parts]
    if sum(below) != trial.whole[1]:
        yield Finding(tree, name, "trial parts", f"{trial.whole[1]} points together", str(sum(below)))
    if len(below) != 2 and (settings.config.method == "stag15" or len(below) < 2):
        yield Finding(tree, name, "trial parts", "two", str(len(below)))
    in_any_case = name == "P" and settings.config.method == "stag15"
    limit = settings.config.ratio_max
    if trial.kept != (ratio < limit or in_any_case):
        kept = "kept" if trial.kept else "rejected"
        yield Finding(tree, name, "trial", f"kept where the ratio is below {limit:g} (T)", f"{kept}, {ratio}")
    if trial.kept == (each.division != "cut"):
        yield Finding(tree, name, "division", "cut where a trial was kept", str(each.division))
    if not frame.settings.independent:
        # A live tree judges a split again by what is below it at that time, however small that has become.
        return
    if min(below, default=0) < frame.points_min:
        yield Finding(
            tree, name, "trial parts", f"at least {frame.points_min:g} points each (T_p)", str(below)
        )
    if trial.kept and each.division == "cut":
        parts = [Measured(part.counted, part.points) for part in frame.parts(name)]
        whole = Measured(each.counted, each.points)
        yield from _compare_ratio(
            tree, name, "of values", ratio_of(frame.tree.metric, whole, parts), each.ratio
        )
        tried = sorted((value or 0.0, points) for value, points in trial.parts)
        if sorted(parts) != tried:
            yield Finding(tree, name, "trial parts", str(sorted(parts)), str(tried))


def _compare_ratio(
    file: str, name: str, where: str, expected: float, found: float | None
) -> Iterator[Finding]:
    same = found is None if math.isinf(expected) else found is not None
    if same and found is not None:
        same = abs(found - expected) <= _ROUNDING * abs(expected)
    if not same:
        yield Finding(file, name, "ratio", f"{expected!r} {where}", repr(found))
