"""Checks that splits (eq. 5) and stop reasons (eq. 6) follow from the settings, the sizes and the values."""

import heapq
import math
from collections.abc import Iterable

import numpy as np

from nurbseg.evaluation.check.exported import ExportedFrame, ExportedSegment, Measured
from nurbseg.segmentation.vocabulary import SPLITS

#: Relative difference of sums in double precision whose order differs.
_ROUNDING = 1e-12
#: Ways in which a segment can be divided.
_KINDS: tuple[str | None, ...] = ("cut", "gap", "crease", "protrusion")
#: Ways in which a segment of a live tree can be divided.
_LIVE_KINDS: tuple[str | None, ...] = ("cut", "gap", "appeared", "crease", "protrusion")

#: Divisions that a trial decides.
_TRIED = ("cut", "crease")


def ratio_of(metric: str, whole: Measured, parts: Iterable[Measured]) -> float:
    """Return the metric of the parts over that of the whole (eq. 5; eq. 13 and 22 for counts).

    Missing values count as 0. Returns inf if the whole's value is 0.
    """
    counted = metric in ("nle", "nlc")
    after = math.fsum((part or 0.0) * (1 if counted else size) for part, size in parts)
    before = (whole.value or 0.0) * (1 if counted else whole.points)
    return after / before if before > 0 else math.inf


def check_splits(frame: ExportedFrame) -> None:
    """Recompute every ratio, and check splits against T, T_d, T_s and T_p."""
    config, step, metric = frame.settings.config, frame.step, frame.tree.metric
    on_grid = np.count_nonzero(frame.leaf_image[::step, ::step])
    grid = f" in all leaves, the pixels with a label of every {step} rows and columns"
    frame.compare("P", "points", on_grid, frame.points_below("P"), grid)
    frame.compare("", "metric", config.metric, metric)
    for name, segment in frame.segments.items():
        kinds = (_KINDS if frame.settings.independent else _LIVE_KINDS) if segment.children else (None,)
        if segment.division not in kinds:
            frame.wrong(name, "division", " or ".join(map(str, kinds)), segment.division)
        if (segment.stop is None) != bool(segment.children):
            frame.wrong(name, "stop", "a reason for leaves alone", segment.stop)
        frame.compare(name, "value", segment.values.get(metric), segment.value)
        # In a live tree, a segment that was not cut has no points of its own.
        if (segment.division == "cut" or frame.settings.independent) and segment.measured == frame.tree.frame:
            frame.compare(name, "points", frame.points_below(name), segment.points, ", the sum of its leaves")
        if segment.division in ("gap", "appeared"):
            if segment.trial is not None or segment.surface:
                frame.wrong(name, "division", "no trial and no surface without a cut", "one of them")
            if config.method == "stag15":
                frame.wrong(name, "division", "cut, as stag15 divides at no gaps", "gap")
        if segment.division == "protrusion":
            _check_protrusion(frame, segment)
        if segment.division == "crease" and (config.method == "stag15" or not config.extended.split_creases):
            frame.wrong(name, "division", "no crease with these settings", segment.division)
        _check_trial(frame, segment)
    splits = [segment.name for segment in frame.segments.values() if segment.division in SPLITS]
    if len(splits) > config.splits_max:
        frame.wrong("", "splits", f"at most {config.splits_max} (T_s)", len(splits))
    for name in splits:
        if frame.cuts_above(name) >= config.depth_max:
            depth = f"{frame.cuts_above(name) + 1} splits above its parts"
            frame.wrong(name, "depth", f"at most {config.depth_max} (T_d)", depth)


def _check_protrusion(frame: ExportedFrame, each: ExportedSegment) -> None:
    """Check that a protrusion is allowed, was not tried as a split, and has as many points as a segment."""
    if frame.settings.config.method == "stag15" or frame.settings.config.extended.protrusion_min == 0:
        frame.wrong(each.name, "division", "no protrusion with these settings", each.division)
    if each.trial is not None:
        frame.wrong(each.name, "trial", "none of a protrusion", each.trial)
    least = min(part.points for part in frame.parts(each.name))
    if frame.settings.independent and least < frame.points_min:
        frame.wrong(each.name, "points", f"at least {frame.points_min:g} in each part (T_p)", least)


def _check_trial(frame: ExportedFrame, each: ExportedSegment) -> None:
    """Check a trial against its ratio, the segment and, if it was kept, its parts."""
    name, trial, settings = each.name, each.trial, frame.settings
    if each.division in _TRIED and (trial is None or not trial.kept):
        frame.wrong(name, "trial", "the one that was kept", trial)
    if trial is None:
        frame.compare(name, "ratio", None, each.ratio, ", nothing was tried")
        return
    frame.compare(name, "trial metric", frame.tree.metric, trial.metric)
    ratio = ratio_of(trial.metric, trial.whole, trial.parts)
    _compare_ratio(frame, each, ratio, "of the trial")
    own = Measured(each.counted, each.points)
    # The labels of a live tree may change after a trial in the same frame.
    same_points = not settings.temporal or trial.points == each.points
    # At creases surfaces are compared at the points that planes explain, which are not exported.
    if each.judged == each.measured and same_points and each.division != "crease":
        frame.compare(name, "trial", tuple(own), tuple(trial.whole), " as value and points")
    below = [points for _, points in trial.parts]
    frame.compare(name, "trial parts", trial.points, sum(below), " points together")
    if len(below) != 2 and (settings.config.method == "stag15" or len(below) < 2):
        frame.wrong(name, "trial parts", "two", len(below))
    in_any_case = name == "P" and settings.config.method == "stag15"
    limit = settings.config.ratio_max
    if trial.kept != (ratio < limit * (1.0 - _ROUNDING) or in_any_case):
        kept = "kept" if trial.kept else "rejected"
        frame.wrong(name, "trial", f"kept where the ratio is below {limit:g} (T)", f"{kept}, {ratio}")
    if trial.kept == (each.division not in _TRIED):
        frame.wrong(name, "division", "cut or crease where a trial was kept", each.division)
    if not settings.independent:
        # A live tree evaluates a split again by its current parts, however small they have become.
        return
    if min(below, default=0) < frame.points_min:
        frame.wrong(name, "trial parts", f"at least {frame.points_min:g} points each (T_p)", below)
    if trial.kept and each.division == "cut":
        parts = [Measured(part.counted, part.points) for part in frame.parts(name)]
        _compare_ratio(frame, each, ratio_of(frame.tree.metric, own, parts), "of values")
        tried = sorted((value or 0.0, points) for value, points in trial.parts)
        frame.compare(name, "trial parts", sorted(map(tuple, parts)), tried)


def _compare_ratio(frame: ExportedFrame, each: ExportedSegment, expected: float, where: str) -> None:
    found = math.inf if each.ratio is None else each.ratio
    if not math.isclose(found, expected, rel_tol=_ROUNDING, abs_tol=0.0):
        frame.wrong(each.name, "ratio", f"{expected!r} {where}", each.ratio)


def check_stops(frame: ExportedFrame) -> None:
    """Check the stop reasons of a tree of one frame by growing it again, the worst segment first."""
    root = frame.segments["P"]
    first = frame.parts("P") if root.division == "gap" else [root]
    waiting = [(-each.counted, each.name) for each in first]
    heapq.heapify(waiting)
    splits, time_is_over = 0, False
    while waiting:
        _, name = heapq.heappop(waiting)
        each = frame.segments[name]
        if each.division in ("crease", "protrusion"):
            # Split off when the tree had grown: its parts were not tried.
            for leaf in frame.below(name):
                reason = "noise" if _reasons(frame, leaf, splits)["noise"] else "untried"
                frame.compare(leaf.name, "stop", reason, leaf.stop)
            continue
        expected = next((reason for reason, holds in _reasons(frame, each, splits).items() if holds), None)
        if expected is None and _hurried(frame, each):
            time_is_over = True
            continue
        if expected is None and time_is_over:
            frame.wrong(name, "stop", "budget, as that of one before it", each.stop or "split")
        if each.division == "cut":
            if expected is not None:
                frame.wrong(name, "stop", expected, "split")
            splits += 1
            for part in frame.parts(name):
                heapq.heappush(waiting, (-part.counted, part.name))
        elif expected is not None or each.trial is not None:
            frame.compare(name, "stop", expected or "criterion", each.stop)
            if expected is not None and each.trial is not None:
                frame.wrong(name, "trial", f"none, it stopped by {expected}", "a trial")
        elif each.stop not in ("no-cut", "child-too-small"):
            frame.wrong(name, "stop", "no-cut or child-too-small, without a trial", each.stop)


def check_live_stops(frame: ExportedFrame) -> None:
    """Check the stop reasons of a live tree's leaves against their values."""
    splits = sum(segment.division in SPLITS for segment in frame.segments.values())
    for leaf in frame.leaves:
        holds = _reasons(frame, leaf, splits)
        holds["criterion"] |= leaf.trial is not None
        holds["pending"] = leaf.trial is None and not any(holds.values())
        holds["budget"] = _hurried(frame, leaf)
        if not holds.get(leaf.stop or "", leaf.stop in ("child-too-small", "no-cut", "untried")):
            frame.wrong(leaf.name, "stop", "a reason that holds", leaf.stop)
        if leaf.trial is not None and leaf.trial.kept:
            frame.wrong(leaf.name, "trial", "one that was rejected", leaf.trial)


def _reasons(frame: ExportedFrame, each: ExportedSegment, splits: int) -> dict[str, bool]:
    """Return the reasons why a segment must not be cut (eq. 6) in their order, and which of them hold."""
    config = frame.settings.config
    has_floor = config.method == "nurbseg" and config.extended.noise_floor > 0 and each.surface
    # A value of 0 cannot improve; the paper's first split needs no improvement.
    first = config.method == "stag15" and each.name == "P" and (each.values.get("mse") or 0.0) > 0
    return {
        # So close to its floor that no ratio of floored values is below T.
        "noise": has_floor and each.floor >= config.ratio_max * each.counted,
        "no-points": each.points == 0,
        "too-small": each.points <= 2.0 * frame.points_min,
        "depth": frame.cuts_above(each.name) >= config.depth_max,
        "splits": splits >= config.splits_max,
        "no-fit": not each.surface,
        "criterion": not (each.counted > 0 or first),
    }


def _hurried(frame: ExportedFrame, each: ExportedSegment) -> bool:
    """Whether a segment may have been left uncut because the frame's time limit was reached."""
    return each.stop == "budget" and frame.settings.config.budget_ms > 0 and each.trial is None
