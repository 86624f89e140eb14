"""The paper's method: a tree of normalized cuts, decided by surface fits (section 3).

Vectors (eq. 1-3) are in `cut/features.py`, the cut in `cut/ncut.py`, surfaces (eq. 4) in `surfaces/fit.py`,
the metrics and their ratios (eq. 7-22) in `surfaces/metrics.py` and `surfaces/curvature.py`, the stop
criteria (eq. 6) in `growth.py`.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.computer import one_blas_thread
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.components import remove_small_components
from nurbseg.segmentation.cut.features import normalization, normalized, raw_vectors
from nurbseg.segmentation.cut.ncut import Cut, normalized_cut
from nurbseg.segmentation.growth import Clock, grow, time_limit
from nurbseg.segmentation.judged import JudgedSplit, Observer, unobserved
from nurbseg.segmentation.points.grid import PixelGrid, decimated_grid, grid_step
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, SegmentationTree, Trial, depth_first, finished_segments
from nurbseg.segmentation.surfaces.curvature import all_metrics
from nurbseg.segmentation.surfaces.fit import Fit, fit_on_grid
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS, acceptance_ratio
from nurbseg.segmentation.upsample import upsample_labels
from nurbseg.segmentation.vocabulary import Division, StopReason

#: Cuts a segment in two, given the grid, its node, the vectors of all grid pixels and the settings.
Cutter = Callable[[PixelGrid, Node, NDArray[np.float32], SegmentationConfig], tuple[Cut, NDArray[np.bool_]]]
#: Fits a surface to some grid pixels.
Fitter = Callable[[PixelGrid, NDArray[np.intp], SegmentationConfig], Fit]


def cut_in_two(
    grid: PixelGrid, node: Node, vectors: NDArray[np.float32], config: SegmentationConfig
) -> tuple[Cut, NDArray[np.bool_]]:
    """Cut a segment in two, and give small components of either side to the other (section 3.1).

    Parameters
    ----------
    grid : PixelGrid
        The points.
    node : Node
        The segment; its random sample depends on its name and the seed only.
    vectors : (h * w, 6) float32
        Vector of each grid pixel (eq. 3).
    config : SegmentationConfig
        Settings of the cut, and T_p.

    Returns
    -------
    cut : Cut
        Without parts, but with a reason, if there is none.
    side : (N,) bool
        Which of the two parts each of the segment's grid pixels belongs to.
    """
    cut = normalized_cut(
        vectors[node.grid_pixels],
        samples=config.samples,
        landmarks=config.landmarks,
        rng=np.random.default_rng([config.seed, int(f"1{node.name}", 2)]),
        affinity_scale=config.affinity_scale,
        splitting_point=config.splitting_point,
        points=config.cut_points,
    )
    return cut, cut.side if cut.reason else _cleaned(
        grid, node.grid_pixels, cut.side, _points_min(grid, config)
    )


def fit_segment(grid: PixelGrid, grid_pixels: NDArray[np.intp], config: SegmentationConfig) -> Fit:
    """Fit a surface to a segment (section 3.2), and compute the metric that decides (section 4).

    Parameters
    ----------
    grid : PixelGrid
        The points.
    grid_pixels : (N,) intp
        Flat indices into the grid, ascending.
    config : SegmentationConfig
        How surfaces are fitted, and the metric.
    """
    fit = fit_on_grid(grid, grid_pixels, config)  # eq. 4; eq. 7, 9, 11 and NLE
    if config.metric in CURVATURE_METRICS:
        fit = replace(fit, values=all_metrics(fit, grid.image_shape[1], config))  # eq. 14-19 and NLC
    return fit


@one_blas_thread()
def segment_stag15(
    cloud: PointMap,
    config: SegmentationConfig,
    *,
    cut: Cutter = cut_in_two,
    fit: Fitter = fit_segment,
    clock: Clock = time.perf_counter,
    observe: Observer = unobserved,
) -> SegmentationTree:
    """Segment a frame by the paper's method; `config.method` is ignored.

    Parameters
    ----------
    cloud, config, clock, observe
        As for `nurbseg.segmentation.methods.segment`, which also describes the result.
    cut, fit : callable
        The two expensive steps, replaceable by versions that cache the results of a frame.

    References
    ----------
    .. [1] G. Pagnutti and P. Zanuttigh, "Scene segmentation based on NURBS surface fitting metrics",
       STAG 2015.
    """
    time_is_over = time_limit(config, clock)
    step = grid_step(cloud.valid, config.decimation)
    config = replace(config, method="stag15", decimation=step)
    grid = decimated_grid(cloud, step)
    grid_pixels = np.flatnonzero(grid.valid)

    # Normalized color and position of every point (section 3.1).
    raw = raw_vectors(cloud, grid.pixels(grid_pixels))  # eq. 1, 2
    scale = normalization(raw, config.geometry_weight)  # the sigmas and lambda of eq. 3
    vectors = np.zeros((grid.valid.size, raw.shape[1]), dtype=np.float32)
    vectors[grid_pixels] = normalized(raw, scale)  # eq. 3

    # The tree (section 3.3).
    root = Node("", grid_pixels, fit(grid, grid_pixels, config))
    grow(
        root,
        lambda node: _split(node, grid, vectors, config, cut, fit, observe),
        _points_min(grid, config),
        config,
        time_is_over,
    )

    image = upsample_labels(cloud, grid, root, lambda pixels: normalized(raw_vectors(cloud, pixels), scale))
    segments = finished_segments(depth_first(root), image)
    return SegmentationTree(segments, cloud.valid.shape, image=image)


def _split(
    node: Node,
    grid: PixelGrid,
    vectors: NDArray[np.float32],
    config: SegmentationConfig,
    cut: Cutter,
    fit: Fitter,
    observe: Observer,
) -> None:
    """Split a segment in two if the fits of its parts are better than its own."""
    found, side = cut(grid, node, vectors, config)
    if found.reason:
        node.stop = StopReason.NO_CUT
        return
    parts = node.grid_pixels[~side], node.grid_pixels[side]
    if min(part.size for part in parts) < _points_min(grid, config):
        node.stop = StopReason.CHILD_TOO_SMALL
        return

    first, second = (
        Node(f"{node.name}{digit}", part, fit(grid, part, config), cuts_above=node.cuts_above + 1)
        for digit, part in enumerate(parts)
    )
    whole, *halves = (each.weighed(config) for each in (node, first, second))
    ratio = acceptance_ratio(config.metric, whole, *halves)
    kept = ratio < config.ratio_max or node.name == ""  # eq. 5, "except for the first iteration"
    node.trial = Trial(config.metric, *whole, tuple(halves), kept)
    observe(JudgedSplit(node.trial, (first.fit, second.fit), (0, 1)))
    if kept:
        node.children, node.division, node.cut = (first, second), Division.CUT, found
    else:
        node.stop = StopReason.CRITERION


def _points_min(grid: PixelGrid, config: SegmentationConfig) -> float:
    """Return T_p in grid pixels."""
    return config.stag15.segment_pixels_min * grid.pixel_share


def _cleaned(
    grid: PixelGrid, grid_pixels: NDArray[np.intp], side: NDArray[np.bool_], points_min: float
) -> NDArray[np.bool_]:
    _, mask = grid.window_mask(grid_pixels)
    image = np.zeros_like(mask)
    image[mask] = side
    return remove_small_components(mask, image, points_min)[mask]
