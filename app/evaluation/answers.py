"""What each variant answers on one frame; what variants have in common is done once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.evaluation.methods.flat import best_lambda
from nurbseg.app.evaluation.methods.methods import CLUSTERS, labels_on_disk, rival
from nurbseg.app.evaluation.variants import LABELS_PREFIX, TREE_METHODS, Variant
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.shared import SharedWork
from nurbseg.segmentation.stag15 import SegmentationTree, segment


class Answers:
    """Segments one frame with one variant after the other; shares what they have in common.

    Parameters
    ----------
    cloud : PointMap
        The registered frame.
    name : str
        Its name, by which label images of other programs are found.
    index : int
        Its place in its source.
    seed : int
        With the frame's place, the state of the random generator of each variant.
    """

    def __init__(self, cloud: PointMap, name: str, index: int, seed: int) -> None:
        self._cloud, self._name, self._index, self._seed = cloud, name, index, seed
        self._shared = SharedWork()
        self._lambdas: dict[tuple[Any, ...], float] = {}

    def of(self, variant: Variant) -> tuple[NDArray[np.integer], SegmentationTree | None]:
        """Return a variant's labels, (H, W), and its tree if it has one.

        Raises
        ------
        ValueError
            If label images of another program lack this frame, or have another size.
        """
        rng = np.random.default_rng([self._seed, self._index])
        if variant.method.startswith(LABELS_PREFIX):
            folder = Path(variant.method.removeprefix(LABELS_PREFIX))
            labels = labels_on_disk(folder, self._name, self._index)
            if labels.shape != self._cloud.valid.shape:
                raise ValueError(
                    f"{folder}: labels of frame {self._name or self._index}: expected "
                    f"{self._cloud.valid.shape} as its depth image, got {labels.shape}"
                )
            return labels, None
        if variant.method not in TREE_METHODS:
            return rival(variant)(self._cloud, rng), None
        config = variant.config
        if variant.lambda_auto:
            chosen = (config.samples, config.affinity_scale)
            if chosen not in self._lambdas:
                self._lambdas[chosen] = best_lambda(self._cloud, config, clusters=CLUSTERS, seed=self._seed)[
                    0
                ]
            config = replace(config, geometry_weight=self._lambdas[chosen])
        tree = segment(self._cloud, config, self._shared)
        return tree.labels(), tree
