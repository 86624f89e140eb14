"""Whether each split and each stop follows from the settings, the sizes and the values (eq. 5 and 6)."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator

import numpy as np

from nurbseg.app.evaluation.check.exported import (
    ExportedFrame,
    ExportedSegment,
    Finding,
    RunSettings,
)

#: Sums of a few numbers in double precision agree to this, whatever their order.
_ROUNDING = 1e-12
#: Largest step of a grid that may be coarser than asked for.
_STEP_MOST = 8


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
        The frame; its root was measured on every point of the grid.
    settings : RunSettings
        Tell the step, unless a rate is held by a coarser grid.
    """
    valid, asked = frame.images["labels"] > 0, settings.config.decimation
    if not valid[::asked, ::asked].any() and valid.any():
        return 1
    if settings.target_fps > 0:
        for step in range(asked, _STEP_MOST + 1):
            if np.count_nonzero(valid[::step, ::step]) == frame.segments["P"].points:
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
    points, all_points = frame.segments["P"].points, np.count_nonzero(frame.leaf_image[::step, ::step])
    if points != all_points:
        expected = f"{all_points}, the pixels with a label of every {step} rows and columns"
        yield Finding(tree, "P", "points", expected, str(points))
    if frame.metric != config.metric:
        yield Finding(tree, "", "metric", config.metric, frame.metric)
    for name, each in frame.segments.items():
        kind = {True: ("cut", "gap"), False: (None,)}[bool(each.children)]
        if each.division not in kind:
            yield Finding(tree, name, "division", " or ".join(map(str, kind)), str(each.division))
        if (each.stop is None) != bool(each.children):
            yield Finding(tree, name, "stop", "a reason for leaves alone", str(each.stop))
        if each.value != each.values.get(frame.metric):
            yield Finding(tree, name, "value", str(each.values.get(frame.metric)), str(each.value))
        if each.children:
            points = sum(frame.segments[child].points for child in each.children)
            if each.points != points:
                yield Finding(tree, name, "points", f"{points}, the sum of its children", str(each.points))
        if each.division == "gap":
            if each.trial is not None or each.surface:
                yield Finding(tree, name, "division", "no trial and no surface at a gap", "one of them")
            if settings.config.method == "stag15":
                yield Finding(tree, name, "division", "cut: stag15 knows no gaps", "gap")
        yield from _check_trial(frame, each, settings, points_min)
    cuts = [each.name for each in frame.segments.values() if each.division == "cut"]
    if len(cuts) > config.splits_max:
        yield Finding(tree, "", "splits", f"at most {config.splits_max} (T_s)", str(len(cuts)))
    for name in cuts:
        if cuts_above(frame, name) >= config.depth_max:
            depth = f"{cuts_above(frame, name) + 1} splits above its parts"
            yield Finding(tree, name, "depth", f"at most {config.depth_max} (T_d)", depth)


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
    if trial.whole != (each.value or 0.0, each.points):
        yield Finding(tree, name, "trial", f"value and points {each.value, each.points}", str(trial.whole))
    below = [points for _, points in trial.parts]
    if sum(below) != trial.whole[1]:
        yield Finding(tree, name, "trial parts", f"{trial.whole[1]} points together", str(sum(below)))
    if min(below, default=0) < points_min:
        yield Finding(tree, name, "trial parts", f"at least {points_min:g} points each (T_p)", str(below))
    if len(below) != 2 and (settings.config.method == "stag15" or len(below) < 2):
        yield Finding(tree, name, "trial parts", "two", str(len(below)))
    in_any_case = name == "P" and settings.config.method == "stag15" and settings.config.first_split == "kept"
    limit = settings.config.ratio_max
    if trial.kept != (ratio < limit or in_any_case):
        kept = "kept" if trial.kept else "rejected"
        yield Finding(tree, name, "trial", f"kept where the ratio is below {limit:g} (T)", f"{kept}, {ratio}")
    if trial.kept == (each.division != "cut"):
        yield Finding(tree, name, "division", "cut where a trial was kept", str(each.division))
    if trial.kept and each.division == "cut":
        parts = [(part.value or 0.0, part.points) for part in frame.parts(name)]
        whole = each.value, each.points
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


def check_stops(frame: ExportedFrame, settings: RunSettings, points_min: float) -> Iterator[Finding]:
    """Grow the tree again in its order, the worst segment first, and hold the reasons against it.

    Parameters
    ----------
    frame : ExportedFrame
        Whose tree was grown for this frame alone.
    settings : RunSettings
        Of its run.
    points_min : float
        T_p in points of the grid.

    Yields
    ------
    Finding
        Each leaf with a reason that is not its own.
    """
    root = frame.segments["P"]
    first = frame.parts("P") if root.division == "gap" else [root]
    waiting = [(-(each.value or 0.0), each.name) for each in first]
    heapq.heapify(waiting)
    splits = 0
    while waiting:
        _, name = heapq.heappop(waiting)
        each = frame.segments[name]
        expected = _early_stop(frame, each, settings, points_min, splits)
        if each.division == "cut":
            if expected is not None:
                yield Finding(frame.tree_file, name, "stop", expected, "split")
            splits += 1
            for part in frame.parts(name):
                heapq.heappush(waiting, (-(part.value or 0.0), part.name))
        elif each.stop == "noise":
            if settings.config.method == "stag15" or not settings.config.noise_stop:
                yield Finding(frame.tree_file, name, "stop", "no noise stop by the settings", "noise")
        elif expected is not None or each.trial is not None:
            if each.stop != (expected or "criterion"):
                yield Finding(frame.tree_file, name, "stop", expected or "criterion", str(each.stop))
            if expected is not None and each.trial is not None:
                yield Finding(frame.tree_file, name, "trial", f"none, it stopped by {expected}", "a trial")
        elif each.stop not in ("no-cut", "child-too-small"):
            yield Finding(
                frame.tree_file, name, "stop", "no-cut or child-too-small, without a trial", str(each.stop)
            )


def _early_stop(
    frame: ExportedFrame, each: ExportedSegment, settings: RunSettings, points_min: float, splits: int
) -> str | None:
    """Return why a segment is not cut at all (eq. 6); None where it is."""
    config = settings.config
    if each.points == 0:
        return "no-points"
    if each.points <= 2.0 * points_min:
        return "too-small"
    if cuts_above(frame, each.name) >= config.depth_max:
        return "depth"
    if splits >= config.splits_max:
        return "splits"
    if not each.surface:
        return "no-fit"
    # What is 0 cannot improve; the paper's first split asks for no improvement.
    first = config.method == "stag15" and each.name == "P" and (each.values.get("mse") or 0.0) > 0
    return None if (each.value or 0.0) > 0 or first else "criterion"


__all__ = ["check_splits", "check_stops", "cuts_above", "grid_step", "ratio_of"]
