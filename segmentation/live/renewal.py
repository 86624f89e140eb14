"""Renewal of the live tree's values, ratios and stop reasons, in each frame or in turn."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.grid_features import GridFeatures
from nurbseg.segmentation.extended.parts import at_noise_floor, fit_segment, judge_split
from nurbseg.segmentation.growth import stop_without_cut
from nurbseg.segmentation.live.editor import NOT_CUT, UpdateReport
from nurbseg.segmentation.live.leaf import LiveLeaf
from nurbseg.segmentation.segments import Node, depth_first, leaf_ranges
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.vocabulary import Division, StopReason

#: Frames within which every split is judged again, and after which a rejected trial is out of date.
SPLIT_FRAMES, TRIAL_FRAMES = 60, 300
#: Grid pixels whose splits are judged again in one frame; at least one split is.
_JUDGED_PIXELS = 4_000


def renew_splits(
    root: Node,
    leaves: Sequence[LiveLeaf],
    labels: NDArray[np.int32],
    features: GridFeatures,
    frame: int,
    config: SegmentationConfig,
    report: UpdateReport,
    *,
    every_surface: bool,
) -> tuple[Node, ...]:
    """Judge splits again by the ratio (eq. 5), the least recently judged ones first.

    One surface is fitted to the whole segment and compared with those of the leaves below it. A segment that
    is not fitted in this frame has no surface, as its last one belongs to another frame.

    Parameters
    ----------
    root : Node
        Of the tree, whose splits get fits and trials.
    leaves : sequence of LiveLeaf
        Of the labels 1, 2, ..., as measured in this frame.
    labels : (h, w) int32
        Labels on the grid.
    features : GridFeatures
        The frame.
    frame : int
        Its number.
    config : SegmentationConfig
        The metric, and T.
    report : UpdateReport
        Gets the number of splits judged, and the age of the oldest value or ratio.
    every_surface : bool
        Whether every segment that was cut gets its surface of this frame; the same splits are judged.

    Returns
    -------
    tuple of Node
        Splits that the ratio no longer keeps, by surfaces that were moved since they were fitted. They are
        undone in the next frame; until then they have the trial by which they were kept last.
    """
    nodes = depth_first(root)
    ranges = leaf_ranges(nodes)
    ends = np.cumsum([0, *(leaf.node.grid_pixels.size for leaf in leaves)])
    for node in nodes:
        if node.division not in (None, Division.CUT) and node.fit.pixels.size:
            # Its pixels are those of its parts; a surface that parts protrude from is of another frame.
            reason, none = node.fit.reason or NOT_CUT, np.zeros(0, dtype=np.intp)
            node.fit, node.measured = Fit(None, np.zeros(0), {}, reason, none), None
    rejected: list[Node] = []
    splits = [node for node in nodes if node.division is Division.CUT]
    judged = counted = 0
    for node in sorted(splits, key=lambda node: -node.age):
        first, end = ranges[node.name]
        size = int(ends[end - 1] - ends[first - 1])
        turn = judged == 0 or counted + size <= _JUDGED_PIXELS or node.age >= SPLIT_FRAMES
        if turn or every_surface:
            own = np.flatnonzero((labels >= first) & (labels < end))
            node.fit, node.measured = fit_segment(features, own, config).fit, frame
        elif node.measured != frame and node.fit.surface is not None:
            reason = f"measured in frame {node.measured}"
            node.fit = replace(node.fit, surface=None, residuals_m=np.zeros(0), reason=reason)
        if not turn:
            continue
        judged, counted = judged + 1, counted + size
        below = (leaf.node for leaf in leaves[first - 1 : end - 1] if leaf.node.grid_pixels.size)
        parts = [each.weighed(config) for each in below]
        trial = judge_split((node.value(config), size), parts, config)
        if trial.kept:
            node.trial, node.judged, node.age = trial, frame, 0
        else:
            rejected.append(node)
    report.judged, report.oldest = judged, max((node.age for node in splits), default=0)
    return tuple(rejected)


def set_stop_reasons(
    leaves: Sequence[LiveLeaf], cuts: int, grid_pixels_min: float, frame: int, config: SegmentationConfig
) -> None:
    """Give every leaf its stop reason, by its measurements in this frame and its last trial.

    Parameters
    ----------
    leaves : sequence of LiveLeaf
        As measured in this frame.
    cuts : int
        Number of cuts in the tree.
    grid_pixels_min : float
        Fewest grid pixels of a segment.
    frame : int
        Number of the frame.
    config : SegmentationConfig
        T_d, T_s, the metric and T.
    """
    for leaf in leaves:
        node, attempt = leaf.node, leaf.attempt
        node.measured = node.judged = frame
        node.trial = None
        if attempt is not None and attempt.trial is not None:
            node.trial, node.judged = attempt.trial, attempt.frame
        # The limit of splits is no reason if a trial was rejected.
        node.stop = stop_without_cut(node, cuts if attempt is None else 0, grid_pixels_min, config)
        if node.grid_pixels.size and node.fit.surface is None:
            node.stop = StopReason.NO_FIT
        elif node.grid_pixels.size and at_noise_floor(node.fit, config):
            node.stop = StopReason.NOISE
        elif node.stop is None and attempt is not None:
            node.stop, node.judged = attempt.stop, attempt.frame
        elif node.stop is None:
            node.stop = StopReason.UNTRIED
