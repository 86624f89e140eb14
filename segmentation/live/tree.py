"""The live tree: a segmentation that is continued from frame to frame."""

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.computer import one_blas_thread
from nurbseg.segmentation.config import TRIALS_MAX, SegmentationConfig
from nurbseg.segmentation.extended.frame import (
    ShownLeaves,
    finished_tree,
    grow_tree,
    shown_leaves,
    ungrown_tree,
)
from nurbseg.segmentation.extended.grid_features import GridFeatures, grid_features
from nurbseg.segmentation.extended.memory import LeafMemory, TreeMemory, leaf_memory
from nurbseg.segmentation.growth import Clock, time_limit
from nurbseg.segmentation.labels.images import apply_lookup_table
from nurbseg.segmentation.live.carry import carry_tree
from nurbseg.segmentation.live.follow import follow_labels
from nurbseg.segmentation.live.motion import brightness, flow_back, warped
from nurbseg.segmentation.live.objects import ObjectMemory
from nurbseg.segmentation.live.question import undo_creases, undo_cuts, undo_protrusions
from nurbseg.segmentation.points.grid import grid_step
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, SegmentationTree, depth_first, leaves_below
from nurbseg.segmentation.upsample import CarriedLabels
from nurbseg.segmentation.vocabulary import StopReason

#: More leaves than this that wait for their first trial, in more frames than this in a row, are too many.
_WAITING_MOST, _WAITING_FRAMES = 6, 5
#: Step of the coarsest grid that a budget may ask for, pixels.
_STEP_MOST = 8


@dataclass(frozen=True, slots=True)
class Budget:
    """How much of the tree is tried again in one frame.

    Parameters
    ----------
    trials : int
        Leaves that are cut, the worst first.
    cut_pixels : float
        Their grid pixels, unless it is one leaf.
    judged_pixels : float
        Grid pixels of the segments whose cuts are judged again.
    coarser : int
        Pixels by which the grid step exceeds the usual one.
    """

    trials: int = TRIALS_MAX
    cut_pixels: float = 12_000
    judged_pixels: float = 40_000
    coarser: int = 0


#: No limit: everything that has changed is tried again in the same frame.
UNLIMITED = Budget(trials=1 << 30, cut_pixels=float("inf"), judged_pixels=float("inf"))


@dataclass(slots=True)
class UpdateReport:
    """What was done to the tree for a frame.

    Parameters
    ----------
    reset : str
        Why the frame was segmented from scratch; empty if the tree was continued.
    unexplained : float
        Share of the points that the moved surfaces did not explain.
    trials, splits, appeared, undone, judged : int
        Numbers of leaves that were cut to try a split, splits made, leaves that came into view, divisions
        undone, and cuts judged again.
    oldest : int
        Frames since the oldest value or ratio of a split was found.
    waiting : int
        Leaves that are pending: to be tried in later frames.
    step : int
        Pixels from one grid pixel to the next.
    """

    reset: str = ""
    unexplained: float = 0.0
    trials: int = 0
    splits: int = 0
    appeared: int = 0
    undone: int = 0
    judged: int = 0
    oldest: int = 0
    waiting: int = 0
    step: int = 1


class LiveTree:
    """Segments frame after frame, each from the tree of the one before.

    Labels are warped by optical flow and surfaces move by the linear change of their points' inverse depth.
    Points that they do not explain are free, every connected component becomes a leaf, and all leaves are
    fitted to this frame. What the frame no longer supports is undone. From there on the stages are those of a
    frame alone, within a budget and without what was tried before and has not changed. What was merged stays
    so while the evidence is undecided. A frame that is not explained is segmented from scratch.

    Parameters
    ----------
    config : SegmentationConfig
        Of the default method.
    clock : callable
        Returns the time, seconds, by which a time budget is measured.

    Attributes
    ----------
    report : UpdateReport
        What was done for the last frame.
    labels_before : (H, W) uint16
        Label of each pixel of the last frame in the tree before; 0 for none. Where a frame was segmented from
        scratch, only of pixels that their surface still explains.

    Raises
    ------
    ValueError
        If the configuration is of another method.
    """

    def __init__(self, config: SegmentationConfig, *, clock: Clock = time.perf_counter) -> None:
        if not supports_live_tree(config):
            raise ValueError(f"method: expected nurbseg, got {config.method}")
        self._config = config
        self._clock = clock
        self.report = UpdateReport()
        self._root: Node | None = None
        self._leaves: list[LeafMemory] = []
        self._shown: ShownLeaves | None = None
        #: Labels of the last frame; pixels without depth in it keep those of the one before.
        self._labels = np.zeros((0, 0), dtype=np.uint16)
        self._gray = np.zeros((0, 0), dtype=np.uint8)
        self._memory = TreeMemory(config)
        self._objects = ObjectMemory()
        self._overdue = 0
        self._restart = ""
        self._frame = -1
        self.labels_before = self._labels

    def restart(self, reason: str) -> None:
        """Segment the next frame from scratch, and report this reason."""
        self._restart = reason

    @one_blas_thread()
    def segment(
        self,
        cloud: PointMap,
        budget: Budget | None = None,
        *,
        frame: int | None = None,
        every_surface: bool = False,
    ) -> SegmentationTree:
        """Segment the next frame.

        Parameters
        ----------
        cloud : PointMap
            The frame.
        budget : Budget, optional
            How much is tried again; its grid also applies to a frame segmented from scratch.
        frame : int, optional
            Its number, by which later trees refer to it; by default the next one.
        every_surface : bool
            Whether segments that were cut get a surface in every frame, not only in turn.

        Returns
        -------
        SegmentationTree
            As that of a single frame. Splitting or removing a part changes the names of those below the same
            split.
        """
        self._frame = self._frame + 1 if frame is None else frame
        budget = budget or Budget()
        usual_step = grid_step(cloud.valid, self._config.decimation)
        config = replace(self._config, decimation=min(usual_step + budget.coarser, _STEP_MOST))
        time_is_over = time_limit(config, self._clock)
        features, gray = grid_features(cloud, config), brightness(cloud.color, config.decimation)
        self.report = UpdateReport(self._no_continuation(cloud), step=config.decimation)
        before = self.labels_before = (
            warped(self._labels, flow_back(gray, self._gray))
            if cloud.valid.shape == self._labels.shape
            else np.zeros(cloud.valid.shape, dtype=np.uint16)
        )
        root = self._carried(before, features, config)
        if root is None:
            root, budget = ungrown_tree(features, config), UNLIMITED
            self._memory, self._objects, self._overdue = TreeMemory(config), ObjectMemory(), 0
        self._memory.begin(root, self._frame)
        if not self.report.reset:
            # First these: a cut is judged with all its points.
            undone = undo_protrusions(root, features, config) + undo_creases(root, features, config)
            self.report.judged, self.report.undone = undo_cuts(
                root,
                self._memory,
                features,
                config,
                pixels_most=budget.judged_pixels,
                every_surface=every_surface,
            )
            self.report.undone += undone
        grow_tree(
            root,
            features,
            config,
            time_is_over,
            self._memory,
            lambda: self._memory.trials >= budget.trials or self._memory.cut_pixels >= budget.cut_pixels,
        )
        self._count(root, config)
        return self._finished(root, cloud, features, config, gray)

    def _no_continuation(self, cloud: PointMap) -> str:
        if self._restart:
            return self._restart
        if not self._leaves:
            return "first frame"
        if cloud.valid.shape != self._labels.shape:
            return "new image size"
        if self._overdue > _WAITING_FRAMES:
            return "more updates than the budget allows"
        return ""

    def _carried(
        self, before: NDArray[np.uint16], features: GridFeatures, config: SegmentationConfig
    ) -> Node | None:
        """Carry the tree into a frame; None, and the report says why, if it is to be segmented from scratch.

        Then `before` loses the labels of pixels that their surface no longer explains.
        """
        shown, step = self._shown, features.grid.step
        if shown is None or self._root is None:
            return None
        noise_per_m, least = config.extended.inverse_depth_noise, features.grid_pixels_min(config)
        carried = follow_labels(before, shown.surfaces, shown.rms_per_m, features.grid, noise_per_m, least)
        appeared = None
        if carried.is_same_scene and not self.report.reset:
            appeared = carry_tree(self._root, carried.labels, self._frame, features, config)
        self.report.unexplained = carried.unexplained
        if appeared is None:
            self.report.reset = self.report.reset or "new scene"
            # Where so much is new, what is in front of a surface or behind it is not what was there.
            is_free = features.grid.valid & (carried.labels == 0)
            height, width = before.shape
            before[is_free.repeat(step, axis=0).repeat(step, axis=1)[:height, :width]] = 0
            return None
        self.report.appeared = appeared
        return self._root

    def _count(self, root: Node, config: SegmentationConfig) -> None:
        memory, report = self._memory, self.report
        report.trials, report.splits = memory.trials, memory.splits
        report.oldest = memory.oldest(root)
        pending = [leaf for leaf in leaves_below(root) if leaf.stop is StopReason.PENDING]
        report.waiting = len(pending)
        never_tried = sum(leaf_memory(leaf).attempt is None for leaf in pending)
        # A time budget would leave a tree from scratch just as unfinished.
        late = never_tried > _WAITING_MOST and config.budget_ms == 0
        self._overdue = self._overdue + 1 if late else 0

    def _finished(
        self,
        root: Node,
        cloud: PointMap,
        features: GridFeatures,
        config: SegmentationConfig,
        gray: NDArray[np.uint8],
    ) -> SegmentationTree:
        """Show the tree in this frame, and keep what the next one begins with."""
        before, nodes = self.labels_before, depth_first(root)
        leaves = [leaf_memory(leaf) for leaf in leaves_below(root)]
        number = {id(leaf): label for label, leaf in enumerate(leaves, start=1)}
        table = np.array([0, *(number.get(id(leaf), 0) for leaf in self._leaves)], dtype=np.uint16)
        shown = shown_leaves(root, cloud, features, config, CarriedLabels(before, table))
        self._root, self._leaves, self._shown, self._restart = root, leaves, shown, ""
        self._gray = gray
        names = [leaf.name for leaf in leaves_below(root)]
        merged = self._objects.merged(leaves, names, shown.labels, shown.surfaces, features.grid, config)
        tree = finished_tree(root, shown, merged, config)
        self._labels, image = apply_lookup_table(table, before), tree.labels("surfaces")
        np.copyto(self._labels, image, where=image > 0)
        for node in nodes:
            node.measured = self._frame if node.measured is None else node.measured
            node.judged = self._frame if node.judged is None else node.judged
        return tree


def supports_live_tree(config: SegmentationConfig) -> bool:
    """Return whether the tree of a configuration can be continued from frame to frame."""
    return config.method == "nurbseg"
