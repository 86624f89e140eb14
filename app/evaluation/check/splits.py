"""Checks that each split follows from the settings, the sizes and the values (eq. 5)."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedSegment, Finding, Measured

#: Relative difference of sums in double precision whose order differs.
_ROUNDING = 1e-12
#: Ways in which a segment can be divided.
_KINDS: tuple[str | None, ...] = ("cut", "gap", "protrusion")
#: Ways in which a segment of a live tree can be divided.
_LIVE_KINDS: tuple[str | None, ...] = ("cut", "gap", "appeared", "protrusion")


def ratio_of(metric: str, whole: Measured, parts: Iterable[Measured]) -> float:
    """Return the metric of the parts over that of the whole (eq. 5; eq. 13 and 22 for counts).

    Missing values count as 0. Returns inf if the whole's value is 0.
    """
    value, points = whole.value or 0.0, whole.points
    counted = metric in ("nle", "nlc")
    after = math.fsum((part or 0.0) * (1 if counted else size) for part, size in parts)
    before = value * (1 if counted else points)
    return after / before if before > 0 else math.inf


def check_splits(frame: ExportedFrame) -> Iterator[Finding]:
    """Recompute every ratio, and check splits against T, T_d, T_s and T_p."""
    config, step = frame.settings.config, frame.step
    points, on_grid = frame.points_below("P"), np.count_nonzero(frame.leaf_image[::step, ::step])
    if points != on_grid:
        expected = f"{on_grid} in all leaves, the pixels with a label of every {step} rows and columns"
        yield frame.wrong("P", "points", expected, points)
    if frame.tree.metric != config.metric:
        yield frame.wrong("", "metric", config.metric, frame.tree.metric)
    for name, each in frame.segments.items():
        kinds = (_KINDS if frame.settings.independent else _LIVE_KINDS) if each.children else (None,)
        if each.division not in kinds:
            yield frame.wrong(name, "division", " or ".join(map(str, kinds)), each.division)
        if (each.stop is None) != bool(each.children):
            yield frame.wrong(name, "stop", "a reason for leaves alone", each.stop)
        if each.value != each.values.get(frame.tree.metric):
            yield frame.wrong(name, "value", each.values.get(frame.tree.metric), each.value)
        # In a live tree, a segment that was not cut has no points of its own.
        own = each.division == "cut" or frame.settings.independent
        if own and each.measured == frame.tree.frame and each.points != frame.points_below(name):
            expected = f"{frame.points_below(name)}, the sum of its leaves"
            yield frame.wrong(name, "points", expected, each.points)
        if each.division in ("gap", "appeared"):
            if each.trial is not None or each.surface:
                yield frame.wrong(name, "division", "no trial and no surface without a cut", "one of them")
            if config.method == "stag15":
                yield frame.wrong(name, "division", "cut, as stag15 divides at no gaps", "gap")
        if each.division == "protrusion":
            yield from _check_protrusion(frame, each)
        yield from _check_trial(frame, each)
    cuts = [each.name for each in frame.segments.values() if each.division == "cut"]
    if len(cuts) > config.splits_max:
        yield frame.wrong("", "splits", f"at most {config.splits_max} (T_s)", len(cuts))
    for name in cuts:
        if frame.cuts_above(name) >= config.depth_max:
            depth = f"{frame.cuts_above(name) + 1} splits above its parts"
            yield frame.wrong(name, "depth", f"at most {config.depth_max} (T_d)", depth)


def _check_protrusion(frame: ExportedFrame, each: ExportedSegment) -> Iterator[Finding]:
    """Check that a protrusion is allowed, was not tried as a split, and has as many points as a segment."""
    if frame.settings.config.method == "stag15" or frame.settings.config.extended.protrusion_min == 0:
        yield frame.wrong(each.name, "division", "no protrusion with these settings", each.division)
    if each.trial is not None:
        yield frame.wrong(each.name, "trial", "none of a protrusion", each.trial)
    least = min(part.points for part in frame.parts(each.name))
    if frame.settings.independent and least < frame.points_min:
        yield frame.wrong(each.name, "points", f"at least {frame.points_min:g} in each part (T_p)", least)


def _check_trial(frame: ExportedFrame, each: ExportedSegment) -> Iterator[Finding]:
    """Check a trial against its ratio, the segment and, if it was kept, its parts."""
    name, trial, settings = each.name, each.trial, frame.settings
    if each.division == "cut" and (trial is None or not trial.kept):
        yield frame.wrong(name, "trial", "the one that was kept", trial)
    if trial is None:
        if each.ratio is not None:
            yield frame.wrong(name, "ratio", "None, nothing was tried", each.ratio)
        return
    if trial.metric != frame.tree.metric:
        yield frame.wrong(name, "trial metric", frame.tree.metric, trial.metric)
    ratio = ratio_of(trial.metric, trial.whole, trial.parts)
    yield from _compare_ratio(frame, each, ratio, "of the trial")
    # The labels of a live tree may change after a trial in the same frame.
    same_points = not settings.temporal or trial.whole[1] == each.points
    if each.judged == each.measured and same_points and trial.whole != (each.counted, each.points):
        yield frame.wrong(name, "trial", f"value and points {each.counted, each.points}", trial.whole)
    below = [points for _, points in trial.parts]
    if sum(below) != trial.whole[1]:
        yield frame.wrong(name, "trial parts", f"{trial.whole[1]} points together", sum(below))
    if len(below) != 2 and (settings.config.method == "stag15" or len(below) < 2):
        yield frame.wrong(name, "trial parts", "two", len(below))
    in_any_case = name == "P" and settings.config.method == "stag15"
    limit = settings.config.ratio_max
    if trial.kept != (ratio < limit * (1.0 - _ROUNDING) or in_any_case):
        kept = "kept" if trial.kept else "rejected"
        yield frame.wrong(name, "trial", f"kept where the ratio is below {limit:g} (T)", f"{kept}, {ratio}")
    if trial.kept == (each.division != "cut"):
        yield frame.wrong(name, "division", "cut where a trial was kept", each.division)
    if not frame.settings.independent:
        # A live tree evaluates a split again by its current parts, however small they have become.
        return
    if min(below, default=0) < frame.points_min:
        yield frame.wrong(name, "trial parts", f"at least {frame.points_min:g} points each (T_p)", below)
    if trial.kept and each.division == "cut":
        parts = [Measured(part.counted, part.points) for part in frame.parts(name)]
        whole = Measured(each.counted, each.points)
        yield from _compare_ratio(frame, each, ratio_of(frame.tree.metric, whole, parts), "of values")
        tried = sorted((value or 0.0, points) for value, points in trial.parts)
        if sorted(parts) != tried:
            yield frame.wrong(name, "trial parts", sorted(parts), tried)


def _compare_ratio(
    frame: ExportedFrame, each: ExportedSegment, expected: float, where: str
) -> Iterator[Finding]:
    found = math.inf if each.ratio is None else each.ratio
    if not math.isclose(found, expected, rel_tol=_ROUNDING, abs_tol=0.0):
        yield frame.wrong(each.name, "ratio", f"{expected!r} {where}", each.ratio)
