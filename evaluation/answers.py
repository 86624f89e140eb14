"""The labels of each variant on one frame; work that variants share is done once."""

import hashlib
from collections.abc import Hashable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.evaluation.methods.flat import best_lambda
from nurbseg.evaluation.methods.methods import CLUSTERS, METHODS, dmzc12, labels_on_disk, method_from
from nurbseg.evaluation.variants import FUNCTION_PREFIX, LABELS_PREFIX, Variant
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.cut.ncut import Cut
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.grid import PixelGrid
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, SegmentationTree
from nurbseg.segmentation.stag15 import cut_in_two, fit_segment, segment_stag15
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS


class SharedWork:
    """Cuts and fits of one frame by the paper's method, computed once for all settings that agree on them.

    A cut depends on a segment's name and points, but not on metric, threshold and limits. For one frame and
    one thread.
    """

    def __init__(self) -> None:
        self._made: dict[Hashable, Any] = {}

    def cut(
        self, grid: PixelGrid, node: Node, vectors: NDArray[np.float32], config: SegmentationConfig
    ) -> tuple[Cut, NDArray[np.bool_]]:
        """Return the result of `cut_in_two`."""
        key = (node.name, _digest(node.grid_pixels), _judged_alike(config, "mse"))
        if key not in self._made:
            self._made[key] = cut_in_two(grid, node, vectors, config)
        found: tuple[Cut, NDArray[np.bool_]] = self._made[key]
        return found

    def fit(self, grid: PixelGrid, grid_pixels: NDArray[np.intp], config: SegmentationConfig) -> Fit:
        """Return the result of `fit_segment`."""
        # A fit has either all residual metrics or all.
        metric: Metric = "vmxc" if config.metric in CURVATURE_METRICS else "mse"
        key = (_digest(grid_pixels), _judged_alike(config, metric))
        if key not in self._made:
            self._made[key] = fit_segment(grid, grid_pixels, config)
        found: Fit = self._made[key]
        return found


def _digest(grid_pixels: NDArray[np.intp]) -> bytes:
    return hashlib.blake2b(grid_pixels.tobytes(), digest_size=16).digest()


def _judged_alike(config: SegmentationConfig, metric: Metric) -> SegmentationConfig:
    """Return the settings without those that do not affect cuts and fits."""
    return replace(config, metric=metric, ratio_max=1.0, depth_max=0, splits_max=0, budget_ms=0.0)


class Answers:
    """Segments one frame with several variants.

    `seed` and the frame's `index` in its source seed each variant's random generator; `name` finds label
    images of other programs.
    """

    def __init__(self, cloud: PointMap, name: str, index: int, seed: int) -> None:
        self._cloud, self._name, self._index, self._seed = cloud, name, index, seed
        self._shared = SharedWork()
        self._lambdas: dict[tuple[Any, ...], float] = {}

    def of(self, variant: Variant) -> tuple[NDArray[np.integer], SegmentationTree | None]:
        """Return a variant's labels, (H, W), and its tree if it has one."""
        rng = np.random.default_rng([self._seed, self._index])
        if variant.method.startswith(LABELS_PREFIX):
            folder = Path(variant.method.removeprefix(LABELS_PREFIX))
            return labels_on_disk(folder, self._name, self._index, self._cloud.valid.shape), None
        if variant.method.startswith(FUNCTION_PREFIX):
            return method_from(variant.method.removeprefix(FUNCTION_PREFIX))(self._cloud, rng), None
        config = variant.config
        if variant.method == "dmzc12":
            return dmzc12(self._cloud, rng, config), None
        if variant.method in METHODS:
            return METHODS[variant.method](self._cloud, rng), None
        if variant.lambda_auto:
            used = (config.samples, config.affinity_scale)
            if used not in self._lambdas:
                self._lambdas[used] = best_lambda(self._cloud, config, clusters=CLUSTERS, seed=self._seed)[0]
            config = replace(config, geometry_weight=self._lambdas[used])
        if config.method == "stag15":
            tree = segment_stag15(self._cloud, config, cut=self._shared.cut, fit=self._shared.fit)
        else:
            tree = segment(self._cloud, config)
        return tree.labels(), tree
