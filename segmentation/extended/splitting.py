"""A split of a segment by the first normalized cut that the ratio keeps."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import Bool, Intp, compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.features import Normalization, normalization, normalized
from nurbseg.segmentation.cut.ncut import Cut, normalized_cuts
from nurbseg.segmentation.extended.grid_features import GridFeatures
from nurbseg.segmentation.extended.parts import children_of, judge_split, nodes_of
from nurbseg.segmentation.judged import JudgedSplit, Observer, unobserved
from nurbseg.segmentation.labels.regions import large_components
from nurbseg.segmentation.segments import Node
from nurbseg.segmentation.vocabulary import Division, StopReason

#: From this many grid pixels on, a segment is cut on every second row and column of the grid.
_MANY_PIXELS = 2_000
#: Above so many floors and, as outliers raise the metric but not the limited residuals, so many deviations,
#: noise does not explain a segment: one more eigenvector is tried.
_FLOORS, _DEVIATIONS = 3.0, 2.2


def split_segment(
    features: GridFeatures, node: Node, config: SegmentationConfig, observe: Observer = unobserved
) -> None:
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
    observe : callable
        Called with every split that is judged.
    """
    drawn = node.grid_pixels
    if drawn.size >= _MANY_PIXELS:
        drawn = features.grid.every_second(drawn)
    raw = features.raw_vectors(drawn)
    scale = normalization(
        raw,
        config.geometry_weight,
        color_weight=config.extended.color_weight,
        normal_weight=config.extended.normal_weight,
    )
    rng = np.random.default_rng(entropy(config.seed, node.first_name))
    node.stop, node.trial = StopReason.NO_CUT, None
    count, least_per_m = config.extended.cuts, _DEVIATIONS * config.extended.inverse_depth_noise
    unexplained = node.value(config) > _FLOORS * node.fit.floor > 0 and node.fit.rms_per_m > least_per_m
    for cut in normalized_cuts(
        normalized(raw, scale),
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
        pieces, side_of = large_pieces(
            features, node.grid_pixels, 1 + sides_of_pixels.astype(np.int32), config
        )
        if len(pieces) < 2:
            node.stop = StopReason.CHILD_TOO_SMALL
            continue
        parts = nodes_of(features.fitter.of_pixels(pieces), config)
        trial = judge_split(node.weighed(config), [part.weighed(config) for part in parts], config)
        observe(JudgedSplit(trial, tuple(part.fit for part in parts), tuple(side - 1 for side in side_of)))
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
def entropy(seed: int, name: str) -> np.random.SeedSequence:
    """Return what the random numbers of a node begin with: frames have nodes of the same names."""
    return np.random.SeedSequence([seed, int(f"1{name}", 2)])


def _extended(
    features: GridFeatures, node: Node, drawn: NDArray[np.intp], cut: Cut, scale: Normalization
) -> NDArray[np.bool_]:
    """Extend a cut of every second grid pixel to all; where those around disagree, by classification."""
    sides, asked = _neighbors_side(cut.side, drawn, node.grid_pixels, *features.grid.shape)
    sides[asked] = cut.classify(normalized(features.raw_vectors(node.grid_pixels[asked]), scale))
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


def large_pieces(
    features: GridFeatures,
    grid_pixels: NDArray[np.intp],
    labels: NDArray[np.int32],
    config: SegmentationConfig,
) -> tuple[list[NDArray[np.intp]], list[int]]:
    """Return the large connected components and their labels; small ones go to their neighbors."""
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
