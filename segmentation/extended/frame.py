"""The default method: the stages of a frame, be it alone or continued from the one before.

A frame alone is an update of the tree that consists of everything: all its points are free, nothing is
remembered, and nothing limits what is tried. A frame that continues another begins with more (see
`nurbseg.segmentation.live`) and then passes through the same stages: `grow_tree` splits, folds and looks for
creases and protrusions, `shown_leaves` refines borders. A new stage of either kind is called there.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.computer import one_blas_thread
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.borders import refine_borders
from nurbseg.segmentation.extended.creases import split_at_creases
from nurbseg.segmentation.extended.folding import fold_leaves
from nurbseg.segmentation.extended.grid_features import GridFeatures, grid_features
from nurbseg.segmentation.extended.memory import TreeMemory
from nurbseg.segmentation.extended.parts import chain_components, nodes_of
from nurbseg.segmentation.extended.protrusions import split_off_protrusions
from nurbseg.segmentation.extended.refitting import refit_surfaces
from nurbseg.segmentation.extended.splitting import large_pieces, split_segment
from nurbseg.segmentation.growth import Clock, grow, time_limit
from nurbseg.segmentation.judged import Observer, unobserved
from nurbseg.segmentation.objects.merge import Objects, merge_surfaces
from nurbseg.segmentation.points.grid import grid_step, inverse_depth_image
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import (
    Node,
    SegmentationTree,
    depth_first,
    finished_segments,
    leaves_below,
    splits_in,
)
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable
from nurbseg.segmentation.upsample import CarriedLabels, upsample_by_depth
from nurbseg.segmentation.vocabulary import StopReason


@one_blas_thread()
def segment_nurbseg(
    cloud: PointMap,
    config: SegmentationConfig,
    *,
    clock: Clock = time.perf_counter,
    observe: Observer = unobserved,
) -> SegmentationTree:
    """Segment a frame into surfaces, and these into objects.

    The paper's tree of normalized cuts decided by surface fits, with normals in the vectors, surfaces fitted
    to inverse depth, cuts divided into connected components, floors of the metrics, borders refined on every
    pixel, and surfaces merged into objects.

    Parameters
    ----------
    cloud, config, clock, observe
        As for `nurbseg.segmentation.methods.segment`.

    Returns
    -------
    SegmentationTree
        Its leaves are surfaces; its objects, none if merging is off, are merged leaves.
    """
    time_is_over = time_limit(config, clock)
    config = replace(config, decimation=grid_step(cloud.valid, config.decimation))
    features = grid_features(cloud, config)
    root = ungrown_tree(features, config)
    grow_tree(root, features, config, time_is_over, observe=observe)
    shown = shown_leaves(root, cloud, features, config)
    names = [leaf.name for leaf in leaves_below(root)]
    merged = merge_surfaces(shown.labels, features.grid, names, shown.surfaces, config)
    return finished_tree(root, shown, merged, config)


def ungrown_tree(features: GridFeatures, config: SegmentationConfig) -> Node:
    """Return the tree of all points: connected components, chained by nodes without a surface."""
    grid_pixels = np.flatnonzero(features.grid.valid)
    everything = np.ones(grid_pixels.size, dtype=np.int32)
    parts = large_pieces(features, grid_pixels, everything, config)[0] or [grid_pixels]
    return chain_components("", nodes_of(features.fitter.of_pixels(parts), config), 0)


def grow_tree(
    root: Node,
    features: GridFeatures,
    config: SegmentationConfig,
    time_is_over: Callable[[], bool],
    memory: TreeMemory | None = None,
    budget: Callable[[], bool] = lambda: False,
    observe: Observer = unobserved,
) -> None:
    """Split what noise does not explain, merge what one surface explains, find creases and protrusions.

    Parameters
    ----------
    root : Node
        Of the tree, which is changed. Every segment has two parts or none; every leaf gets its stop reason.
    features : GridFeatures
        The frame.
    config : SegmentationConfig
        Thresholds and choices.
    time_is_over : callable
        As for `grow`.
    memory : TreeMemory, optional
        What need not be tried again, as nothing has changed since it was.
    budget : callable
        Whether enough was cut in this frame; leaves that are not cut for that are ``pending``.
    observe : callable
        Called with every split that is judged.
    """
    least = features.grid_pixels_min(config)
    split: Callable[[Node], None] = partial(_split, features, config, observe)
    if memory is not None:
        memory.recall(root, features)
        split = memory.remembering(split)
    grow(root, split, least, config, lambda: time_is_over() or budget(), splits=splits_in(root))
    if not time_is_over():
        for leaf in leaves_below(root):
            leaf.stop = StopReason.PENDING if leaf.stop is StopReason.BUDGET else leaf.stop
    if config.extended.fold_surfaces and not time_is_over():
        is_asked = [] if memory is None else [memory.meet_newly]
        fold_leaves(root, features, config, *is_asked, observe=observe)
    if config.extended.split_creases and not time_is_over():
        split_at_creases(root, features, config, *([] if memory is None else [memory.is_bent_anew]))
        if memory is not None:
            memory.name_new(root)
    if config.extended.protrusion_min > 0 and not time_is_over():
        if memory is None:
            split_off_protrusions(root, features, config)
        else:
            split_off_protrusions(
                root, features, config, lambda leaf, far: memory.has_more_far(leaf, far, least)
            )
            memory.name_new(root)


def _split(features: GridFeatures, config: SegmentationConfig, observe: Observer, node: Node) -> None:
    split_segment(features, node, config, observe)


@dataclass(frozen=True, slots=True, eq=False)
class ShownLeaves:
    """The leaves of a tree as they are shown: on every pixel, with the surfaces that drew their borders.

    Parameters
    ----------
    labels : (H, W) int32
        Index of each pixel's leaf plus one; 0 where there is no point.
    surfaces : SurfaceTable
        Of the leaves, by label.
    rms_per_m : list of float
        Their root mean square residuals, 1/m.
    """

    labels: NDArray[np.int32]
    surfaces: SurfaceTable
    rms_per_m: list[float]


def shown_leaves(
    root: Node,
    cloud: PointMap,
    features: GridFeatures,
    config: SegmentationConfig,
    carried: CarriedLabels | None = None,
) -> ShownLeaves:
    """Refine the borders of the leaves on the grid, fit surfaces again that changed, and label every pixel.

    Parameters
    ----------
    root : Node
        Of the tree.
    cloud, features : PointMap, GridFeatures
        The frame.
    config : SegmentationConfig
        As for `refine_borders`.
    carried : CarriedLabels, optional
        Labels of the pixels in the frame before: borders begin where these are.
    """
    leaves = leaves_below(root)
    on_grid = np.zeros(features.grid.valid.shape, dtype=np.int32)
    for label, leaf in enumerate(leaves, start=1):
        on_grid.reshape(-1)[leaf.grid_pixels] = label
    fits = [leaf.fit for leaf in leaves]
    fitted, rms_per_m = [fit.surface for fit in fits], [fit.rms_per_m for fit in fits]
    if config.extended.refine_borders:
        on_grid, fitted, rms_per_m = refit_surfaces(on_grid, fits, features.fitter, config)
    inverse_depth, surfaces = inverse_depth_image(cloud), SurfaceTable(fitted)
    labels = upsample_by_depth(on_grid, inverse_depth, cloud.valid, config, carried)
    if config.extended.refine_borders:
        labels = refine_borders(labels, inverse_depth, surfaces, config, rms_per_m=rms_per_m)
    return ShownLeaves(labels, surfaces, rms_per_m)


def finished_tree(
    root: Node,
    shown: ShownLeaves,
    merged: Objects,
    config: SegmentationConfig,
) -> SegmentationTree:
    """Return the tree of nodes, of their labels on every pixel, and of what was merged, as a value."""
    image = shown.labels.astype(np.uint16)
    segments = finished_segments(depth_first(root), image)
    return SegmentationTree(segments, image.shape, *merged, config.extended.level, image)
