"""The default method: surfaces by normalized cuts, refined borders, and objects of merged surfaces."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import Bool, Intp, compiled
from nurbseg.segmentation.blas import one_blas_thread
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.features import Normalization, normalization, normalized
from nurbseg.segmentation.cut.ncut import Cut, normalized_cuts
from nurbseg.segmentation.extended.borders import refine_borders
from nurbseg.segmentation.extended.folding import fold_leaves
from nurbseg.segmentation.extended.grid_features import GridFeatures, grid_features
from nurbseg.segmentation.extended.merge import merge_surfaces
from nurbseg.segmentation.extended.parts import chain_components, children_of, fit_segment, judge_split
from nurbseg.segmentation.extended.protrusions import split_off_protrusions
from nurbseg.segmentation.extended.refitting import refit_surfaces
from nurbseg.segmentation.extended.things import join_objects
from nurbseg.segmentation.growth import Clock, grow, time_limit
from nurbseg.segmentation.labels.regions import large_components
from nurbseg.segmentation.labels.upsample import upsample_by_depth
from nurbseg.segmentation.points.grid import grid_step, inverse_depth_image
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, SegmentationTree, depth_first, finished_segments
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable
from nurbseg.segmentation.vocabulary import Division, StopReason

#: From this many grid pixels on, a segment is cut on every second row and column of the grid.
_MANY_PIXELS = 2_000
#: Above so many floors and, as outliers raise the metric but not the limited residuals, so many deviations,
#: noise does not explain a segment: one more eigenvector is tried.
_FLOORS, _DEVIATIONS = 3.0, 2.2


@one_blas_thread()
def segment_nurbseg(
    cloud: PointMap, config: SegmentationConfig, *, clock: Clock = time.perf_counter
) -> SegmentationTree:
    """Segment a frame into surfaces, and these into objects.

    The paper's tree of normalized cuts decided by surface fits, with normals in the vectors, surfaces fitted
    to inverse depth, cuts divided into connected components, floors of the metrics, borders refined on every
    pixel, and surfaces merged into objects.

    Parameters
    ----------
    cloud, config, clock
        As for `nurbseg.segmentation.methods.segment`.

    Returns
    -------
    SegmentationTree
        Its leaves are surfaces; its objects, none if merging is off, are merged leaves.
    """
    time_is_over = time_limit(config, clock)
    config = replace(config, decimation=grid_step(cloud.valid, config.decimation))
    features = grid_features(cloud, config)
    root = grown_tree(features, config, time_is_over)
    nodes = depth_first(root)
    leaves = [node for node in nodes if not node.children]

    on_grid = np.zeros(features.grid.valid.shape, dtype=np.int32)
    for label, leaf in enumerate(leaves, start=1):
        on_grid.reshape(-1)[leaf.grid_pixels] = label
    fits = [leaf.fit for leaf in leaves]
    surfaces, rms_per_m = [fit.surface for fit in fits], [fit.rms_per_m for fit in fits]
    if config.extended.refine_borders:
        on_grid, surfaces, rms_per_m = refit_surfaces(on_grid, fits, features.grid, config)
    inverse_depth, table = inverse_depth_image(cloud), SurfaceTable(surfaces)
    labels = upsample_by_depth(on_grid, inverse_depth, cloud.valid, config)
    if config.extended.refine_borders:
        labels = refine_borders(labels, inverse_depth, table, config, rms_per_m=rms_per_m)

    image = labels.astype(np.uint16)
    segments = finished_segments(nodes, image)
    names = [leaf.name for leaf in leaves]
    objects, contacts = merge_surfaces(labels, features.grid, names, table, config)
    on_grid = labels[:: features.grid.step, :: features.grid.step]
    objects, joins = join_objects(objects, contacts, on_grid, names, features.grid, cloud.color, config)
    return SegmentationTree(
        segments, cloud.valid.shape, objects, contacts, config.extended.level, image, joins
    )


def grown_tree(features: GridFeatures, config: SegmentationConfig, time_is_over: Callable[[], bool]) -> Node:
    """Grow the tree of surfaces on the grid, merge what one surface explains, and split off protrusions.

    Parameters
    ----------
    features : GridFeatures
        The frame.
    config : SegmentationConfig
        Thresholds and choices.
    time_is_over : callable
        As for `grow`.

    Returns
    -------
    Node
        The root. Components of the frame, or of a side of a cut, are chained by nodes without a surface, so
        that every segment has two parts or none.
    """
    grid_pixels = np.flatnonzero(features.grid.valid)
    parts = _pieces(features, grid_pixels, np.ones(grid_pixels.size, dtype=np.int32), config)[0] or [
        grid_pixels
    ]
    root = chain_components("", [fit_segment(features, part, config) for part in parts], 0)
    grow(
        root,
        lambda node: split_segment(features, node, config),
        features.grid_pixels_min(config),
        config,
        time_is_over,
    )
    if config.extended.fold_surfaces and not time_is_over():
        fold_leaves(root, features, config)
    if config.extended.protrusion_min > 0 and not time_is_over():
        split_off_protrusions(root, features, config)
    return root


def split_segment(features: GridFeatures, node: Node, config: SegmentationConfig) -> None:
    """Try the cuts of a segment in turn, and split it by the first one that the ratio keeps.

    Parameters
    ----------
    features : GridFeatures
        The frame; its vectors are read at the node's grid pixels.
    node : Node
        The segment. Gets the trial of the split that is kept or else of the best one and, if one is kept, its
        cut and the connected components of both sides as children; if none is, the reason.
    config : SegmentationConfig
        Thresholds and choices.
    """
    drawn = node.grid_pixels
    if drawn.size >= _MANY_PIXELS:
        drawn = features.grid.every_second(drawn)
    scale = normalization(
        features.raw,
        config.geometry_weight,
        color_weight=config.extended.color_weight,
        normal_weight=config.extended.normal_weight,
        rows=drawn,
    )
    rng = np.random.default_rng(_entropy(config.seed, node.name))
    node.stop, node.trial = StopReason.NO_CUT, None
    count, least_per_m = config.extended.cuts, _DEVIATIONS * config.extended.inverse_depth_noise
    unexplained = node.value(config) > _FLOORS * node.fit.floor > 0 and node.fit.rms_per_m > least_per_m
    for cut in normalized_cuts(
        normalized(features.raw, scale, drawn),
        count=count + (count > 1 and unexplained),
        samples=config.samples,
        landmarks=config.landmarks,
        rng=rng,
        affinity_scale=config.affinity_scale,
        splitting_point=config.splitting_point,
        points=config.cut_points,
    ):
        if cut.reason:
            continue
        sides_of_pixels = (
            cut.side if drawn is node.grid_pixels else _extended(features, node, drawn, cut, scale)
        )
        pieces, side_of = _pieces(features, node.grid_pixels, 1 + sides_of_pixels.astype(np.int32), config)
        if len(pieces) < 2:
            node.stop = StopReason.CHILD_TOO_SMALL
            continue
        parts = [fit_segment(features, piece, config) for piece in pieces]
        trial = judge_split(node.weighed(config), [part.weighed(config) for part in parts], config)
        if trial.kept or node.trial is None or trial.ratio < node.trial.ratio:
            node.trial = trial
        if trial.kept:
            first, second = ([parts[n] for n, of in enumerate(side_of) if of == side] for side in (1, 2))
            node.children = children_of(node, (first, second))
            node.division, node.cut, node.stop = Division.CUT, cut if first and second else None, None
            return
        node.stop = StopReason.CRITERION
    if node.trial is not None:
        # The ratio of an earlier cut counts more than why a later one failed.
        node.stop = StopReason.CRITERION


@lru_cache(maxsize=256)
def _entropy(seed: int, name: str) -> np.random.SeedSequence:
    """Return what the random numbers of a node begin with: frames have nodes of the same names."""
    return np.random.SeedSequence([seed, int(f"1{name}", 2)])


def _extended(
    features: GridFeatures, node: Node, drawn: NDArray[np.intp], cut: Cut, scale: Normalization
) -> NDArray[np.bool_]:
    """Extend a cut of every second grid pixel to all; where those around disagree, by classification."""
    sides, asked = _neighbors_side(cut.side, drawn, node.grid_pixels, *features.grid.shape)
    sides[asked] = cut.classify(normalized(features.raw, scale, node.grid_pixels[asked]))
    return sides


@compiled
def _neighbors_side(
    drawn_side: Bool, drawn: Intp, grid_pixels: Intp, height: int, width: int
) -> tuple[Bool, Intp]:
    """Return the side of the drawn grid pixels around each, and which have none, or both, around."""
    # Bit 0 for the False side and bit 1 for the True one, at every second row and column.
    corners = np.zeros(((height + 1) // 2 + 1, (width + 1) // 2 + 1), dtype=np.uint8)
    row = 0
    for n in range(drawn.size):
        # Grid pixels ascend; a division is slower.
        while drawn[n] >= (row + 1) * width:
            row += 1
        corners[np.uint32(row >> 1), np.uint32((drawn[n] - row * width) >> 1)] = 2 if drawn_side[n] else 1
    for a in range(corners.shape[0] - 1):
        for b in range(corners.shape[1] - 1):
            corners[a, b] |= corners[a + 1, b] | corners[a, b + 1] | corners[a + 1, b + 1]
    sides, asked = np.empty(grid_pixels.size, dtype=np.bool_), np.empty(grid_pixels.size, dtype=np.intp)
    row, count = 0, 0
    for n in range(grid_pixels.size):
        while grid_pixels[n] >= (row + 1) * width:
            row += 1
        around = corners[np.uint32(row >> 1), np.uint32((grid_pixels[n] - row * width) >> 1)]
        sides[n] = around == 2
        asked[count] = n
        count += (around == 0) | (around == 3)
    return sides, asked[:count].copy()


def _pieces(
    features: GridFeatures,
    grid_pixels: NDArray[np.intp],
    labels: NDArray[np.int32],
    config: SegmentationConfig,
) -> tuple[list[NDArray[np.intp]], list[int]]:
    """Return the large connected components and their labels; small ones go to their neighbours."""
    if grid_pixels.size == 0:
        return [], []
    return large_components(
        grid_pixels,
        labels,
        features.adjacency,
        features.grid.inverse_depth,
        gap_per_m=config.extended.inverse_depth_gap,
        grid_pixels_min=features.grid_pixels_min(config),
    )
