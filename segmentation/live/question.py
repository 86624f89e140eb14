"""Divisions of a carried tree that this frame no longer supports: they are undone."""

import numpy as np

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.creases import ANGLE_LEAST, PIECE_FACTOR, angle_between, plane_through
from nurbseg.segmentation.extended.folding import remove_node
from nurbseg.segmentation.extended.grid_features import GridFeatures
from nurbseg.segmentation.extended.memory import (
    TreeMemory,
    cuts_in,
    largest_leaf,
    leaf_memory,
)
from nurbseg.segmentation.extended.parts import RATIO_ROUNDING, at_noise_floor, judge_split
from nurbseg.segmentation.live.carry import renew_unions
from nurbseg.segmentation.segments import Node, depth_first, leaves_below
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable
from nurbseg.segmentation.vocabulary import Division, StopReason

#: Weight of a frame in the average of a cut's ratio; and what ratio over T ends a cut at once.
_NEW_SHARE, _CLEAR_RATIO = 0.2, 1.3
#: Frames within which every cut is judged again.
SPLIT_FRAMES = 60
#: A protrusion lasts while so much of it is in front of the surface by more than this share of the limit.
_STILL_SHARE, _STILL_LIMIT = 0.5, 0.7
#: A crease lasts while planes meet at more than this share of the least angle.
_STILL_ANGLE = 0.7


def undo_cuts(
    root: Node,
    memory: TreeMemory,
    features: GridFeatures,
    config: SegmentationConfig,
    *,
    pixels_most: float,
    every_surface: bool,
) -> tuple[int, int]:
    """Judge cuts again by the ratio (eq. 5), and undo those that it no longer keeps.

    One surface is fitted to the whole segment and compared with those of the leaves below it. A cut is undone
    when the average of its ratio over frames passes T, or its ratio is clearly above. Those whose turn it is
    are judged: large segments, which take longer, less often.

    Parameters
    ----------
    root : Node
        Of the tree, which is changed.
    memory : TreeMemory
        Averages the ratios.
    features : GridFeatures
        The frame.
    config : SegmentationConfig
        The metric, and T.
    pixels_most : float
        Grid pixels of the segments that are judged; one at least is.
    every_surface : bool
        Whether every segment that was cut gets its surface of this frame; the same cuts are judged.

    Returns
    -------
    judged, undone : int
        How many cuts.
    """
    age = memory.frames_since_judged
    judged = counted = undone = 0
    waiting = sorted(cuts_in(root), key=lambda node: (-age(node) / node.grid_pixels.size, node.name))
    for node in waiting:
        if node.division is not Division.CUT:
            # A segment above it is a leaf now.
            continue
        turn = counted + node.grid_pixels.size <= pixels_most or not judged or age(node) >= SPLIT_FRAMES
        if turn or every_surface:
            fits = [leaf.fit for leaf in leaves_below(node)]
            (node.grid_pixels, node.fit), node.measured = features.fitter.of_union(fits), None
        if not turn:
            continue
        judged, counted = judged + 1, counted + node.grid_pixels.size
        parts = [leaf.weighed(config) for leaf in leaves_below(node)]
        trial = judge_split(node.weighed(config), parts, config)
        average = memory.average_ratio(node, trial.ratio, _NEW_SHARE)
        if trial.kept:
            node.trial, node.judged = trial, None
        is_above = average > -RATIO_ROUNDING or trial.ratio > _CLEAR_RATIO * config.ratio_max
        if node.fit.surface is not None and is_above:
            _undo(node, config)
            undone += 1
    return judged, undone


def _undo(node: Node, config: SegmentationConfig) -> None:
    """Make a leaf of a segment again."""
    memory = leaf_memory(largest_leaf(node))
    memory.attempt = None
    for below in depth_first(node)[1:]:
        below.division = None
    node.children, node.division, node.cut, node.trial, node.judged = (), None, None, None, None
    node.memory = memory
    node.stop = StopReason.NOISE if at_noise_floor(node.fit, config) else None


def undo_creases(root: Node, features: GridFeatures, config: SegmentationConfig) -> int:
    """Make one leaf again of segments whose planes no longer meet in a crease; return how many.

    The limit is less than when they were split, so that what is near it does not come and go.

    Parameters
    ----------
    root : Node
        Of the tree, which is changed.
    features : GridFeatures
        The frame.
    config : SegmentationConfig
        The noise, and T_p.
    """
    undone, noise_per_m = 0, config.extended.inverse_depth_noise
    least = PIECE_FACTOR * features.grid_pixels_min(config)
    for node in depth_first(root):
        if node.division is not Division.CREASE:
            continue
        large = [leaf.grid_pixels for leaf in leaves_below(node) if leaf.grid_pixels.size >= least]
        planes = [plane_through(each, features.grid, noise_per_m)[0] for each in large]
        if len(planes) > 1 and angle_between(planes) < _STILL_ANGLE * ANGLE_LEAST:
            fits = [leaf.fit for leaf in leaves_below(node)]
            (node.grid_pixels, node.fit), node.measured = features.fitter.of_union(fits), None
            _undo(node, config)
            undone += 1
    return undone


def undo_protrusions(root: Node, features: GridFeatures, config: SegmentationConfig) -> int:
    """Give protrusions back that are no longer in front of the surface behind them; return how many.

    Like when they were split off, each point counts by itself. The limit is less than then, so that what is
    near it does not come and go.

    Parameters
    ----------
    root : Node
        Of the tree, which is changed.
    features : GridFeatures
        The frame.
    config : SegmentationConfig
        The limit `protrusion_min` and the noise.
    """
    undone, nodes = 0, depth_first(root)
    present = {id(node) for node in nodes}
    for node in nodes:
        # A parent takes over its only child, which is in the tree no longer.
        if id(node) not in present or not node.children or node.division is not Division.PROTRUSION:
            continue
        remaining, protruding = node.children
        rest = largest_leaf(remaining)
        for part in leaves_below(protruding):
            if not _is_in_front(part, rest, features, config):
                rest.grid_pixels, rest.fit = features.fitter.of_union((rest.fit, part.fit))
                rest.stop = StopReason.NOISE if at_noise_floor(rest.fit, config) else None
                rest.trial, leaf_memory(rest).attempt = None, None
                remove_node(root, part)
                present = {id(node) for node in depth_first(root)}
                undone += 1
                break
    if undone:
        renew_unions(root)
    return undone


def _is_in_front(part: Node, rest: Node, features: GridFeatures, config: SegmentationConfig) -> bool:
    if rest.fit.surface is None:
        return True
    grid = features.grid
    rows, columns = np.divmod(part.grid_pixels.astype(np.int32), np.int32(grid.shape[1]))
    step = np.int32(grid.step)
    ones = np.ones(part.grid_pixels.size, dtype=np.int32)
    explained = SurfaceTable([rest.fit.surface]).inverse_depths(ones, rows * step, columns * step)
    noise_per_m = max(config.extended.inverse_depth_noise, rest.fit.rms_per_m)
    in_front = grid.inverse_depth.reshape(-1)[part.grid_pixels] - explained
    limit_per_m = _STILL_LIMIT * config.extended.protrusion_min * noise_per_m
    return bool(np.mean(in_front > limit_per_m) >= _STILL_SHARE)
