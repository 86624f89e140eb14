"""A tree whose leaves are upright bands of a wall, as the live tree holds it between two frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from plates import SHAPE, WALL_PER_M, Box, cloud_of, inside_of

from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.extended.grid_features import GridFeatures, grid_features
from nurbseg.segmentation.extended.parts import fit_segment
from nurbseg.segmentation.live.editor import TreeEditor, UpdateReport
from nurbseg.segmentation.live.leaf import LeafPair, LiveLeaf, Misfit
from nurbseg.segmentation.live.updater import Budget, TreeUpdate
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, Trial
from nurbseg.segmentation.vocabulary import Division

#: A segment has at least 25 places of the grid of every second pixel. Surfaces are too stiff for a step.
CONFIG = SegmentationConfig(
    decimation=2,
    samples=60,
    extended=ExtendedConfig(
        level="surfaces",
        inverse_depth_noise=5e-4,
        piece_pixels_min=1600,
        knot_spacing_px=50.0,
        smoothness=1.0,
    ),
)
GRID = SHAPE[0] // 2, SHAPE[1] // 2
#: The frame before the one that is looked at.
BEFORE, FRAME = 40, 41


@dataclass
class Band:
    """Columns and rows of the grid that a leaf has, and how much nearer than the wall it is, 1/m."""

    name: str
    columns: int
    nearer_per_m: float = 0.0
    rows: int = GRID[0]


@dataclass
class Updated:
    """What an update leaves: the leaves, working numbers on the grid, their labels, and what was done."""

    leaves: list[LiveLeaf]
    on_grid: NDArray[np.int32]
    final: NDArray[np.uint16]
    report: UpdateReport


@dataclass
class DesignedTree:
    """A frame, its labels on the grid, and the tree of them."""

    cloud: PointMap
    features: GridFeatures
    labels: NDArray[np.int32]
    root: Node
    leaves: list[LiveLeaf]
    nodes: dict[str, Node]
    compared: dict[LeafPair, int] = field(default_factory=dict)

    def update(
        self,
        *,
        appeared: NDArray[np.int32] | None = None,
        square: Sequence[float] = (),
        unreached: Sequence[float] = (),
        same_object: Sequence[tuple[int, int]] = (),
        rejected: Sequence[Node] = (),
        budget: Budget | None = None,
        config: SegmentationConfig = CONFIG,
    ) -> Updated:
        """Update the tree; by default nothing is amiss, and nothing is in the budget.

        Two leaves of one object are given by their labels.
        """
        count = len(self.leaves) + 1
        places = np.bincount(self.labels.ravel(), minlength=count)
        misfit = Misfit(
            places,
            np.array([0.0, *square]) if square else np.ones(count),
            np.array([0.0, *unreached]) if unreached else np.zeros(count),
        )
        editor = TreeEditor(self.root, self.leaves, self.labels)
        nothing = Budget(refits=0, trials=0, merges=0)
        TreeUpdate(editor, self.cloud, self.features, misfit, FRAME, budget or nothing, config).run(
            rejected,
            np.zeros(GRID, np.int32) if appeared is None else appeared,
            {frozenset(self.leaves[label - 1] for label in pair) for pair in same_object},
            self.compared,
        )
        leaves, final = editor.finished()
        return Updated(leaves, editor.labels, final, editor.report)


def designed_tree(
    *bands: Band, boxes: Sequence[Box] = (), config: SegmentationConfig = CONFIG
) -> DesignedTree:
    """Build the tree of some bands, whose names say what is cut where.

    Parameters
    ----------
    *bands : Band
        From left to right, in the order of the tree. What they leave of the wall has no label.
    boxes : sequence of Box
        Plates of another color, 0.02 / m nearer than what they stand on, pixels.
    """
    inverse_depth = np.full(SHAPE, WALL_PER_M)
    labels = np.zeros(GRID, np.int32)
    left = 0
    for label, band in enumerate(bands, start=1):
        labels[: band.rows, left : left + band.columns] = label
        inverse_depth[: 2 * band.rows, 2 * left : 2 * (left + band.columns)] += band.nearer_per_m
        left += band.columns
    color = np.full((*SHAPE, 3), 120.0)
    for box in boxes:
        inverse_depth[inside_of(box)] += 0.02
        color[inside_of(box)] = 200, 60, 40
    cloud = cloud_of(inverse_depth, color)
    features = grid_features(cloud, config)

    nodes: dict[str, Node] = {}
    for label, band in enumerate(bands, start=1):
        places = np.flatnonzero(labels == label)
        nodes[band.name] = Node(band.name, places, fit_segment(features, places, config).fit)
    inner = {band.name[:end] for band in bands for end in range(len(band.name))}
    for name in sorted(inner, key=len, reverse=True):
        children = nodes[f"{name}0"], nodes[f"{name}1"]
        places = np.sort(np.concatenate([child.grid_pixels for child in children]))
        node = nodes[name] = Node(
            name, places, fit_segment(features, places, config).fit, children, Division.CUT
        )
        node.trial = Trial("mse", 9.0, places.size, ((1.0, places.size),), True)
    for node in nodes.values():
        node.cuts_above, node.measured, node.judged = len(node.name), BEFORE, BEFORE
    leaves = [LiveLeaf(nodes[band.name]) for band in bands]
    return DesignedTree(cloud, features, labels, nodes[""], leaves, nodes)
