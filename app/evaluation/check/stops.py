"""Checks the reason why each leaf stopped, by growing the tree again in its order (eq. 6)."""

import heapq
from collections.abc import Iterator

from nurbseg.app.evaluation.check.exported import ExportedFrame, ExportedSegment, Finding
from nurbseg.segmentation.config import SegmentationConfig


def check_stops(frame: ExportedFrame) -> Iterator[Finding]:
    """Check the stop reasons of a tree of one frame by growing it again, the worst segment first."""
    root = frame.segments["P"]
    first = frame.parts("P") if root.division == "gap" else [root]
    waiting = [(-each.counted, each.name) for each in first]
    heapq.heapify(waiting)
    splits, time_is_over = 0, False
    while waiting:
        _, name = heapq.heappop(waiting)
        each = frame.segments[name]
        if each.division == "protrusion":
            # Split off when the tree had grown: its parts were not tried.
            for leaf in frame.below(name):
                stop = "noise" if _hopeless(leaf, frame.settings.config) else "untried"
                if leaf.stop != stop:
                    yield frame.wrong(leaf.name, "stop", stop, leaf.stop)
            continue
        expected = _early_stop(frame, each, splits)
        if expected is None and _hurried(frame, each):
            time_is_over = True
            continue
        if expected is None and time_is_over:
            found = each.stop or "split"
            yield frame.wrong(name, "stop", "budget, as that of one before it", found)
        if each.division == "cut":
            if expected is not None:
                yield frame.wrong(name, "stop", expected, "split")
            splits += 1
            for part in frame.parts(name):
                heapq.heappush(waiting, (-part.counted, part.name))
        elif expected is not None or each.trial is not None:
            if each.stop != (expected or "criterion"):
                yield frame.wrong(name, "stop", expected or "criterion", each.stop)
            if expected is not None and each.trial is not None:
                yield frame.wrong(name, "trial", f"none, it stopped by {expected}", "a trial")
        elif each.stop not in ("no-cut", "child-too-small"):
            yield frame.wrong(name, "stop", "no-cut or child-too-small, without a trial", each.stop)


def _early_stop(frame: ExportedFrame, each: ExportedSegment, splits: int) -> str | None:
    """Return why a segment must not be cut (eq. 6); None if it must."""
    config = frame.settings.config
    if _hopeless(each, config):
        return "noise"
    if each.points == 0:
        return "no-points"
    if each.points <= 2.0 * frame.points_min:
        return "too-small"
    if frame.cuts_above(each.name) >= config.depth_max:
        return "depth"
    if splits >= config.splits_max:
        return "splits"
    if not each.surface:
        return "no-fit"
    # A value of 0 cannot improve; the paper's first split needs no improvement.
    first = config.method == "stag15" and each.name == "P" and (each.values.get("mse") or 0.0) > 0
    return None if each.counted > 0 or first else "criterion"


def _hurried(frame: ExportedFrame, each: ExportedSegment) -> bool:
    """Whether a segment may have been left uncut because the frame's time limit was reached."""
    return each.stop == "budget" and frame.settings.config.budget_ms > 0 and each.trial is None


def _hopeless(each: ExportedSegment, config: SegmentationConfig) -> bool:
    """Whether a value is so close to its floor that no ratio of floored values is below T."""
    has_floor = config.method == "nurbseg" and config.extended.noise_floor > 0 and each.surface
    return has_floor and each.floor >= config.ratio_max * each.counted


def check_live_stops(frame: ExportedFrame) -> Iterator[Finding]:
    """Check the stop reasons of a live tree's leaves against their values."""
    config = frame.settings.config
    cuts = sum(each.division == "cut" for each in frame.segments.values())
    for leaf in frame.leaves():
        tried = leaf.trial is not None
        holds = {
            "no-points": leaf.points == 0,
            "too-small": leaf.points <= 2.0 * frame.points_min,
            "depth": frame.cuts_above(leaf.name) >= config.depth_max,
            "splits": cuts >= config.splits_max,
            "no-fit": not leaf.surface,
            "noise": _hopeless(leaf, config),
            "criterion": tried or not leaf.counted > 0,
            "child-too-small": True,
            "no-cut": True,
            "untried": True,
            "budget": _hurried(frame, leaf),
        }
        if not holds.get(leaf.stop or "", False):
            yield frame.wrong(leaf.name, "stop", "a reason that holds", leaf.stop)
        if leaf.trial is not None and leaf.trial.kept:
            yield frame.wrong(leaf.name, "trial", "one that was rejected", leaf.trial)
