"""The live tree: a segmentation that is continued from frame to frame, and updated where necessary."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.blas import one_blas_thread
from nurbseg.segmentation.config import OUTLIER_DEVIATIONS, SegmentationConfig
from nurbseg.segmentation.extended.borders import own_deviations
from nurbseg.segmentation.extended.grid_features import GridFeatures
from nurbseg.segmentation.extended.parts import fit_segment
from nurbseg.segmentation.extended.splitting import segment_nurbseg
from nurbseg.segmentation.labels.images import apply_lookup_table
from nurbseg.segmentation.labels.regions import pixel_adjacency
from nurbseg.segmentation.labels.spreading import spread_labels
from nurbseg.segmentation.live.borders import relax_borders, spread_to_pixels
from nurbseg.segmentation.live.editor import TreeEditor, UpdateReport
from nurbseg.segmentation.live.follow import grown_labels, moved_surfaces, new_components
from nurbseg.segmentation.live.leaf import Attempt, LeafPair, LiveLeaf, misfit, update_residuals
from nurbseg.segmentation.live.motion import brightness, flow_back, warped
from nurbseg.segmentation.live.objects import ObjectMemory
from nurbseg.segmentation.live.renewal import renew_splits, set_stop_reasons
from nurbseg.segmentation.live.updater import Budget, TreeUpdate
from nurbseg.segmentation.points.grid import depth_grid, grid_step, inverse_depth_image
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Node, SegmentationTree, depth_first, finished_segments, history
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice
from nurbseg.segmentation.vocabulary import TRIED, Division, StopReason

#: Share of points unexplained by the surfaces of the frame before that means a new scene.
_CHANGED_SHARE = 0.4
#: More leaves than this waiting for a trial, in more frames than this in a row, are too many for updates.
_WAITING_MOST, _WAITING_FRAMES = 6, 15
#: Step of the coarsest grid that a budget may ask for, pixels.
_STEP_MOST = 8


class LiveTree:
    """Segments frame after frame, each from the tree of the one before.

    Labels are warped by optical flow, surfaces move by the linear change of their points' inverse depth, and
    borders are relaxed. Then the tree is updated within a budget, the worst first: leaves are fitted again,
    leaves that have become worse are tried for a split, and splits of what one surface explains are undone.
    Evidence along borders is filtered over time, so that objects do not flicker. A frame that is not
    explained is segmented from scratch.

    Parameters
    ----------
    config : SegmentationConfig
        Of the default method.

    Attributes
    ----------
    report : UpdateReport
        What was done for the last frame.
    labels_before : (H, W) uint16
        Label of each pixel of the last frame in the tree before; 0 for none.

    Raises
    ------
    ValueError
        If the configuration is of another method.
    """

    def __init__(self, config: SegmentationConfig) -> None:
        if not supports_live_tree(config):
            raise ValueError(f"method: expected nurbseg, got {config.method}")
        self._config = config
        self.report = UpdateReport()
        self._leaves: list[LiveLeaf] = []
        self._root = Node(
            "", np.zeros(0, dtype=np.intp), Fit(None, np.zeros(0), {}, "", np.zeros(0, dtype=np.intp))
        )
        self._labels = np.zeros((0, 0), dtype=np.uint16)
        self._gray = np.zeros((0, 0), dtype=np.uint8)
        self._objects = ObjectMemory()
        self._compared: dict[LeafPair, int] = {}
        self._overdue = 0
        self._restart = ""
        self._rejected: tuple[Node, ...] = ()
        self._frame = -1
        self._lattice = SurfaceLattice([], 1)
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
            How much may be updated; its grid also applies to a frame segmented from scratch.
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
        reason = self._no_continuation(cloud)
        if not reason:
            tree = self._followed(cloud, config, budget, every_surface)
            if tree is not None:
                return tree
            reason = self.report.reset
        tree = segment_nurbseg(cloud, config)
        self._take_over(tree, cloud, config.decimation)
        self.report.reset, self.report.step = reason, config.decimation
        return tree

    def _no_continuation(self, cloud: PointMap) -> str:
        if not self._leaves:
            return "first frame"
        if self._restart:
            return self._restart
        if cloud.valid.shape != self._labels.shape:
            return "new image size"
        if self._overdue > _WAITING_FRAMES:
            return "more updates than the budget allows"
        return ""

    def _take_over(self, tree: SegmentationTree, cloud: PointMap, step: int) -> None:
        """Start from a tree that was grown for this frame alone, on a grid of some step, pixels."""
        nodes = {
            each.name: Node(
                each.name,
                np.zeros(0, dtype=np.intp),
                each.fit,
                **{**history(each), "measured": self._frame, "judged": self._frame},
            )
            for each in tree.segments
        }
        for each in tree.segments:
            if each.children:
                nodes[each.name].children = (nodes[each.children[0]], nodes[each.children[1]])
        self._root = nodes[""]
        self._leaves = [LiveLeaf(nodes[leaf.name]) for leaf in tree.leaves()]
        for leaf in self._leaves:
            leaf.rms_per_m = leaf.node.fit.rms_per_m
            if leaf.node.stop in TRIED:
                leaf.attempt = Attempt(leaf.node.stop, leaf.node.trial, self._frame)
            elif leaf.node.stop is StopReason.BUDGET:
                leaf.tried = 0.0
        self._rejected = ()
        self.labels_before = np.zeros(tree.shape, dtype=np.uint16)
        self._labels = tree.labels("surfaces").copy()
        self._lattice = SurfaceLattice([leaf.surface for leaf in self._leaves], step)
        self._gray = brightness(cloud.color, step)
        self._objects = ObjectMemory()
        self._overdue = 0
        self._restart = ""
        self.report = UpdateReport()

    def _followed(
        self, cloud: PointMap, config: SegmentationConfig, budget: Budget, every_surface: bool
    ) -> SegmentationTree | None:
        """Continue the tree in a frame; None if the frame is not explained."""
        step = config.decimation
        noise_per_m, gap_per_m = config.extended.inverse_depth_noise, config.extended.inverse_depth_gap
        inverse_depth = inverse_depth_image(cloud)
        grid = depth_grid(cloud, step)
        gray = brightness(cloud.color, step)
        before = warped(self._labels, flow_back(gray, self._gray))
        on_grid = np.where(grid.valid, before[::step, ::step], 0).astype(np.int32)

        # Surfaces move with their points; pixels that they do not explain lose their label.
        surfaces = [leaf.surface for leaf in self._leaves]
        if self._lattice.step != step:
            self._lattice = SurfaceLattice(surfaces, step)
        surfaces = moved_surfaces(surfaces, self._lattice, on_grid, grid.inverse_depth, noise_per_m)
        lattice = SurfaceLattice(surfaces, step)
        own = [OUTLIER_DEVIATIONS * leaf.rms_per_m for leaf in self._leaves]
        limits = np.maximum([0.0, *own], gap_per_m).astype(np.float32)
        points, known = int(np.count_nonzero(grid.valid)), int(np.count_nonzero(on_grid))
        is_explained = np.abs(lattice.image(on_grid) - grid.inverse_depth) < limits.take(on_grid)
        on_grid = np.where(is_explained, on_grid, 0)
        unexplained = 1.0 - int(np.count_nonzero(on_grid)) / max(1, known)
        if unexplained > _CHANGED_SHARE or known < (1.0 - _CHANGED_SHARE) * points:
            self.report = UpdateReport(reset="new scene", unexplained=unexplained)
            return None
        for leaf, surface in zip(self._leaves, surfaces, strict=True):
            leaf.surface = surface
            leaf.age += 1
            if leaf.attempt is not None:
                leaf.attempt.age += 1
        for node in depth_first(self._root):
            node.age += 1

        # Labels grow into unlabelled pixels; what stays unlabelled is new, or too small.
        on_grid = grown_labels(on_grid, grid.inverse_depth, lattice, limits)
        adjacency = pixel_adjacency(grid.inverse_depth, grid.valid, gap_per_m)
        features = GridFeatures(grid, adjacency, np.zeros((0, 0), dtype=np.float32))
        on_grid, appeared = new_components(on_grid, features, len(self._leaves), config)

        # Borders on every pixel.
        labels = spread_to_pixels(before, on_grid, inverse_depth, step)
        if config.extended.refine_borders:
            deviations = own_deviations([leaf.rms_per_m for leaf in self._leaves], noise_per_m)
            labels = relax_borders(labels, inverse_depth, lattice, deviations, gap_per_m=gap_per_m)
        on_grid = np.where(grid.valid & (appeared == 0), labels[::step, ::step], 0).astype(np.int32)

        # The tree is updated.
        measures = misfit(on_grid, lattice, grid, noise_per_m, len(self._leaves))
        editor = TreeEditor(self._root, self._leaves, on_grid)
        update = TreeUpdate(editor, cloud, features, measures, self._frame, budget, config)
        update.run(self._rejected, appeared, self._objects.same_object, self._compared)
        self._leaves, final = editor.finished()
        alive = set(self._leaves)
        self._compared = {pair: at for pair, at in self._compared.items() if pair <= alive}
        labels = editor.relabelled(labels, final, inverse_depth, step)
        missed = np.flatnonzero((labels == 0) & (inverse_depth > 0))
        if missed.size:
            spread = spread_labels(labels.astype(np.int32), missed, inverse_depth, gap_per_m)
            labels = spread.astype(np.uint16)
        self.labels_before = before
        # Pixels without depth in this frame keep their label for the next one.
        self._labels = apply_lookup_table(final, before)
        np.copyto(self._labels, labels, where=labels > 0)
        self._gray = gray
        # A time budget would leave a tree from scratch just as unfinished.
        late = editor.report.waiting > _WAITING_MOST and config.budget_ms == 0
        self._overdue = self._overdue + 1 if late else 0
        self.report = editor.report
        self.report.unexplained, self.report.step = unexplained, step
        return self._finished(cloud, features, labels, config, every_surface)

    def _finished(
        self,
        cloud: PointMap,
        features: GridFeatures,
        labels: NDArray[np.uint16],
        config: SegmentationConfig,
        every_surface: bool,
    ) -> SegmentationTree:
        """Measure the tree in this frame, and return it."""
        grid, leaves = features.grid, self._leaves
        on_grid = labels[:: grid.step, :: grid.step].astype(np.int32)
        self._lattice = SurfaceLattice([leaf.surface for leaf in leaves], grid.step)
        not_reached = update_residuals(leaves, on_grid, self._lattice, grid, config)
        for leaf in not_reached:
            leaf.refit(fit_segment(features, leaf.node.grid_pixels, config))
        if not_reached:
            self._lattice = SurfaceLattice([leaf.surface for leaf in leaves], grid.step)
        self._rejected = renew_splits(
            self._root,
            leaves,
            on_grid,
            features,
            self._frame,
            config,
            self.report,
            every_surface=every_surface,
        )
        nodes = depth_first(self._root)
        cuts = sum(node.division is Division.CUT for node in nodes)
        set_stop_reasons(leaves, cuts, features.grid_pixels_min(config), self._frame, config)
        self.report.oldest_trial = max(leaf.attempt_age for leaf in leaves)
        segments = finished_segments(nodes, labels)
        objects, contacts = self._objects.merged(leaves, on_grid, self._lattice, grid, config)
        objects, joins = self._objects.joined(objects, contacts, leaves, on_grid, grid, cloud.color, config)
        return SegmentationTree(
            segments, cloud.valid.shape, objects, contacts, config.extended.level, labels, joins
        )


def supports_live_tree(config: SegmentationConfig) -> bool:
    """Return whether the tree of a configuration can be continued from frame to frame."""
    return config.method == "nurbseg"
