"""Whether each split follows from the settings, the sizes and the values (eq. 5)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedSegment, Finding, RunSettings

#: Sums of a few numbers in double precision agree to this, whatever their order.
_ROUNDING = 1e-12
#: Largest step of a grid that may be coarser than asked for.
_STEP_MOST = 8
#: How segments of a live tree may fall into their children.
_LIVE_KINDS = ("cut", "gap", "appeared")


def ratio_of(
    metric: str, whole: tuple[float | None, int], parts: Iterable[tuple[float | None, int]]
) -> float:
    """Return the metric of the parts over that of the whole (eq. 5; eq. 13 and 22 for counts).

    Parameters
    ----------
    metric : str
        Which of the nine.
    whole, *parts : (float or None, int)
        Value and number of points; None is nothing measured, and counts as 0.

    Returns
    -------
    float
        inf where the whole's value is 0.
    """
    value, points = whole[0] or 0.0, whole[1]
    counted = metric in ("nle", "nlc")
    after = math.fsum((part or 0.0) * (1 if counted else size) for part, size in parts)
    before = value * (1 if counted else points)
    return after / before if before > 0 else math.inf


def grid_step(frame: ExportedFrame, settings: RunSettings) -> int:
    """Return the step of the grid on which a frame's splits were decided.

    Parameters
    ----------
    frame : ExportedFrame
        The frame; its leaves were measured on every point of the grid.
    settings : RunSettings
        Tell the step, unless a rate is held by a coarser grid.
    """
    valid, asked = frame.images["labels"] > 0, settings.config.decimation
    if not valid[::asked, ::asked].any() and valid.any():
        return 1
    if settings.target_fps > 0:
        for step in range(asked, _STEP_MOST + 1):
            if np.count_nonzero(valid[::step, ::step]) == points_below(frame, "P"):
                return step
    return asked


def check_splits(frame: ExportedFrame, settings: RunSettings, points_min: float) -> Iterator[Finding]:
    """Recompute every ratio, and hold splits against T, T_d, T_s and T_p.

    Parameters
    ----------
    frame : ExportedFrame
        With names that are right.
    settings : RunSettings
        Of its run.
    points_min : float
        T_p in points of the grid.

    Yields
    ------
    Finding
        Each contradiction.
    """
    tree, config = frame.tree_file, settings.config
    step = grid_step(frame, settings)
    points, on_grid = points_below(frame, "P"), np.count_nonzero(frame.leaf_image[::step, ::step])
    if points != on_grid:
        expected = f"{on_grid} in all leaves, the pixels with a label of every {step} rows and columns"
        yield Finding(tree, "P", "points", expected, str(points))
    if frame.metric != config.metric:
        yield Finding(tree, "", "metric", config.metric, frame.metric)
    for name, each in frame.segments.items():
        kinds = (("cut", "gap") if settings.grows_anew else _LIVE_KINDS) if each.children else (None,)
        if each.division not in kinds:
            yield Finding(tree, name, "division", " or ".join(map(str, kinds)), str(each.division))
        if (each.stop is None) != bool(each.children):
            yield Finding(tree, name, "stop", "a reason for leaves alone", str(each.stop))
        if each.value != each.values.get(frame.metric):
            yield Finding(tree, name, "value", str(each.values.get(frame.metric)), str(each.value))
        # What a live tree holds together without a cut has no points of its own.
        own = each.division == "cut" or settings.grows_anew
        if own and each.measured == frame.frame and each.points != points_below(frame, name):
            expected = f"{points_below(frame, name)}, the sum of its leaves"
            yield Finding(tree, name, "points", expected, str(each.points))
        if each.division in ("gap", "appeared"):
            if each.trial is not None or each.surface:
                yield Finding(tree, name, "division", "no trial and no surface without a cut", "one of them")
            if config.method == "stag15":
                yield Finding(tree, name, "division", "cut: stag15 knows no gaps", "gap")
        yield from _check_trial(frame, each, settings, points_min)
    cuts = [each.name for each in frame.segments.values() if each.division == "cut"]
    if len(cuts) > config.splits_max:
        yield Finding(tree, "", "splits", f"at most {config.splits_max} (T_s)", str(len(cuts)))
    for name in cuts:
        if cuts_above(frame, name) >= config.depth_max:
            depth = f"{cuts_above(frame, name) + 1} splits above its parts"
            yield Finding(tree, name, "depth", f"at most {config.depth_max} (T_d)", depth)


def points_below(frame: ExportedFrame, name: str) -> int:
    """Return the number of points of all leaves below a segment."""
    return sum(leaf.points for leaf in frame.below(name))


def _check_trial(
    frame: ExportedFrame, each: ExportedSegment, settings: RunSettings, points_min: float
) -> Iterator[Finding]:
    """Hold a trial against its own ratio, the segment and, if it was kept, its parts."""
    tree, name, trial = frame.tree_file, each.name, each.trial
    if each.division == "cut" and (trial is None or not trial.kept):
        yield Finding(tree, name, "trial", "the one that was kept", str(trial))
    if trial is None:
        if each.ratio is not None:
            yield Finding(tree, name, "ratio", "None, nothing was tried", str(each.ratio))
        return
    if trial.metric != frame.metric:
        yield Finding(tree, name, "trial metric", frame.metric, trial.metric)
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
    if not settings.grows_anew:
        # A live tree judges a split again by what is below it at that time, however small that has become.
        return
    if min(below, default=0) < points_min:
        yield Finding(tree, name, "trial parts", f"at least {points_min:g} points each (T_p)", str(below))
    if trial.kept and each.division == "cut":
        parts = [(part.counted, part.points) for part in frame.parts(name)]
        whole = each.counted, each.points
        yield from _compare_ratio(tree, name, "of values", ratio_of(frame.metric, whole, parts), each.ratio)
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


def cuts_above(frame: ExportedFrame, name: str) -> int:
    """Return the number of cuts between the root and a segment."""
    return sum(frame.segments[name[:end]].division == "cut" for end in range(1, len(name)))
