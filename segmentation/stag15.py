"""The recursive segmentation: a tree of normalized cuts, decided by surface fits (section 3.3)."""

from __future__ import annotations

import heapq
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.blas import one_blas_thread
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.components import remove_small_components
from nurbseg.segmentation.cut.features import normalization, normalized, raw_vectors
from nurbseg.segmentation.cut.ncut import Cut, normalized_cut
from nurbseg.segmentation.extended.splitting import segment_nurbseg
from nurbseg.segmentation.labels.segment_pixels import finished_segments
from nurbseg.segmentation.labels.upsample import Split, upsample_labels
from nurbseg.segmentation.points.grid import PixelGrid, decimated_grid, step_with_points
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import (
    Division,
    Node,
    Segment,
    SegmentationTree,
    StopReason,
    Trial,
    depth_first,
)
from nurbseg.segmentation.shared import SharedWork
from nurbseg.segmentation.surfaces.curvature import all_metrics
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS, acceptance_ratio
from nurbseg.segmentation.surfaces.surface import Fit, fit_on_grid, has_least_norm


def segment(
    cloud: PointMap, config: SegmentationConfig, shared: SharedWork | None = None
) -> SegmentationTree:
    """Segment a frame into surfaces (section 3).

    Parameters
    ----------
    cloud : PointMap
        Points and their colors.
    config : SegmentationConfig
        Thresholds and choices; the same seed gives the same tree.
    shared : SharedWork, optional
        What other settings of the paper's method have made of this very frame.

    Returns
    -------
    SegmentationTree
        Every segment with its surface, metrics, ratio and, for a leaf, the reason why it is one. A frame
        with too few points is one leaf.

    References
    ----------
    .. [1] G. Pagnutti and P. Zanuttigh, "GridFeatures segmentation based on NURBS surface fitting metrics",
       STAG 2015.
    """
    with one_blas_thread():
        if config.method == "nurbseg":
            return segment_nurbseg(cloud, config)
        return segment_stag15(cloud, config, shared)


def segment_stag15(
    cloud: PointMap, config: SegmentationConfig, shared: SharedWork | None = None
) -> SegmentationTree:
    """Segment a frame as the paper does; as `segment`, whatever the method set."""
    shared = shared or SharedWork()
    config = replace(config, decimation=step_with_points(cloud.valid, config.decimation))
    grid = shared.once(config, "grid", lambda: decimated_grid(cloud, config.decimation))
    places = np.flatnonzero(grid.valid)
    raw = shared.once(config, "raw vectors", lambda: raw_vectors(cloud, grid.pixels(places)))
    scale = normalization(raw, config.geometry_weight)
    root = grow(grid, places, normalized(raw, scale), config, shared)

    nodes = depth_first(root)
    leaves = [node for node in nodes if not node.children]
    splits = _splits(nodes, leaves)
    labels = upsample_labels(
        cloud,
        grid,
        [leaf.places for leaf in leaves],
        splits,
        lambda pixels: normalized(raw_vectors(cloud, pixels), scale),
    )
    image = ((labels + 1) % (len(leaves) + 1)).astype(np.uint16).reshape(cloud.valid.shape)
    return SegmentationTree(finished_segments(nodes, leaves, image), cloud.valid.shape, image=image)


def grow(
    grid: PixelGrid,
    places: NDArray[np.intp],
    vectors: NDArray[np.float32],
    config: SegmentationConfig,
    shared: SharedWork,
) -> Node:
    """Grow the tree on the grid, the worst open segment first.

    Parameters
    ----------
    grid : PixelGrid
        The points.
    places : (N,) intp
        Flat places on the grid that have a point, ascending.
    vectors : (N, D) float32
        Feature vector of each.
    config : SegmentationConfig
        Thresholds and choices.
    shared : SharedWork
        Cuts and fits made before, of segments of the same names.

    Returns
    -------
    node
        The root.
    """
    segment_min = config.stag15.segment_pixels_min * grid.pixel_share
    row_of_place = np.zeros(grid.valid.size, dtype=np.intp)
    row_of_place[places] = np.arange(places.size)
    root = Node("", places, _measured(grid, "", places, config, shared))
    waiting: list[tuple[float, str, Node]] = [(-root.value(config), root.name, root)]
    splits = 0
    while waiting:
        _, _, node = heapq.heappop(waiting)
        # Conditions that need no cut (eq. 6).
        node.stop = _reason_not_to_try(node, splits, segment_min, config)
        if node.stop is not None:
            continue

        # Cut in two, and clean up (section 3.1).
        cut, side = shared.once(
            config, ("cut", node.name), partial(_cut, grid, node, vectors, row_of_place, segment_min, config)
        )
        if cut.reason:
            node.stop = StopReason.NO_CUT
            continue
        parts = node.places[~side], node.places[side]
        if min(part.size for part in parts) < segment_min:
            node.stop = StopReason.CHILD_TOO_SMALL
            continue

        # Fit a surface to each part (section 3.2), and keep the split if they explain it better (eq. 5).
        children = tuple(
            Node(name, part, _measured(grid, name, part, config, shared))
            for name, part in zip((f"{node.name}0", f"{node.name}1"), parts, strict=True)
        )
        first, second = children
        whole, *halves = ((each.value(config), each.places.size) for each in (node, first, second))
        ratio = acceptance_ratio(config.metric, whole, *halves)
        kept = ratio < config.ratio_max or node is root
        node.trial = Trial(config.metric, *whole, tuple(halves), kept)
        if not kept:
            node.stop = StopReason.CRITERION
            continue
        node.children, node.division, node.cut = (first, second), Division.CUT, cut
        splits += 1
        for child in children:
            heapq.heappush(waiting, (-child.value(config), child.name, child))
    return root


def _cut(
    grid: PixelGrid,
    node: Node,
    vectors: NDArray[np.float32],
    row_of_place: NDArray[np.intp],
    segment_min: float,
    config: SegmentationConfig,
) -> tuple[Cut, NDArray[np.bool_]]:
    """Cut a segment in two, and give small pieces of either side to the other."""
    cut = normalized_cut(
        vectors[row_of_place[node.places]],
        samples=config.samples,
        rng=_generator(config.seed, node.name),
        affinity_scale=config.affinity_scale,
        splitting_point=config.splitting_point,
        points=config.cut_points,
    )
    return cut, cut.side if cut.reason else _cleaned(grid, node.places, cut.side, segment_min)


def _measured(
    grid: PixelGrid, name: str, places: NDArray[np.intp], config: SegmentationConfig, shared: SharedWork
) -> Fit:
    """Fit a surface, with the metric that decides among its values."""
    kind = "fit of least norm" if has_least_norm(config) else "fit"
    fit = shared.once(config, (kind, name), lambda: fit_on_grid(grid, places, config))
    if config.metric not in CURVATURE_METRICS:
        return fit
    return shared.once(
        config,
        ("curved fit", name),
        lambda: replace(fit, values=all_metrics(fit, grid.image_shape[1], config)),
    )


def _reason_not_to_try(
    node: Node, splits: int, segment_min: float, config: SegmentationConfig
) -> StopReason | None:
    if node.places.size == 0:
        return StopReason.NO_POINTS
    if node.places.size <= 2.0 * segment_min:
        return StopReason.TOO_SMALL
    if len(node.name) >= config.depth_max:
        return StopReason.DEPTH
    if splits >= config.splits_max:
        return StopReason.SPLITS
    if node.fit.surface is None:
        return StopReason.NO_FIT
    if not node.value(config) > 0 and not (node.name == "" and node.fit.values["mse"] > 0):
        # What is 0 cannot improve.
        return StopReason.CRITERION
    return None


def _generator(seed: int, name: str) -> np.random.Generator:
    """Return the random numbers of one segment, whatever was split before it."""
    return np.random.default_rng([seed, int(f"1{name}", 2)])


def _cleaned(
    grid: PixelGrid, places: NDArray[np.intp], side: NDArray[np.bool_], segment_min: float
) -> NDArray[np.bool_]:
    """Give small pieces of either side to the other, on the window of the segment."""
    rows, columns, (top, left, bottom, right) = grid.locate(places)
    at = rows - top, columns - left
    mask = np.zeros((bottom - top, right - left), dtype=np.bool_)
    mask[at] = True
    image = np.zeros_like(mask)
    image[at] = side
    cleaned: NDArray[np.bool_] = remove_small_components(mask, image, segment_min)[at]
    return cleaned


def _splits(nodes: list[Node], leaves: list[Node]) -> list[Split]:
    """Describe each kept split by the ranges of leaves below its parts; leaves are in depth-first order."""
    names = [leaf.name for leaf in leaves]
    splits = []
    for node in nodes:
        if node.children and node.cut is not None:
            below = [i for i, name in enumerate(names) if name.startswith(node.name)]
            first = sum(names[i].startswith(node.children[0].name) for i in below)
            splits.append(Split(below[0], below[0] + first, below[-1] + 1, node.cut))
    return splits


__all__ = ["Segment", "SegmentationTree", "StopReason", "grow", "segment", "segment_stag15"]
