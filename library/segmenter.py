"""Segmentation of single frames, and of sequences: each continues the previous one, at a rate that holds."""

import logging
import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import RGBDFrame, check_frame
from nurbseg.library.result import FrameResult, new_tracker
from nurbseg.segmentation.config import TRIALS_MAX, SegmentationConfig
from nurbseg.segmentation.labels.images import apply_lookup_table
from nurbseg.segmentation.live.identity import Identities, track_identities
from nurbseg.segmentation.live.tree import UNLIMITED, Budget, LiveTree, supports_live_tree
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap, Registration
from nurbseg.segmentation.segments import SegmentationTree

_log = logging.getLogger(__name__)

#: Share of the frame period that a frame has waited for the one before if it is late, what is updated in it,
#: and how many frames in a row may be so brief; each one in time allows another.
_LATE, _BRIEF, _BRIEF_MOST = 0.15, Budget(trials=0, judged_pixels=0), 6
#: Share of the frame period above which the grid becomes coarser, and below which it may become finer.
_FULL, _SPARE = 0.9, 0.8
#: Share of the frame period above which even the first, slow frames make the grid coarser.
_HOPELESS = 1.25
#: Number of frames whose median time counts, and that must be slow for a change while the rate holds.
_FRAMES, _SUSTAINED = 30, 90
#: Number of frames between two changes: to a coarser and to a finer grid.
_DOWN_AFTER, _UP_AFTER = 8, 60
#: Number of frames after which a finer grid is tried regardless of its earlier cost.
_FORGET_AFTER = 3600


class Segmenter:
    """Segments a sequence of frames.

    Parameters
    ----------
    config : SegmentationConfig, optional
        Settings of the segmentation.
    temporal : bool
        Whether a frame continues the previous one: segments keep their identities and, with the default
        method, the tree of the previous frame is updated.
    target_hz : float
        Frame rate to maintain by doing less per frame, 1/s; 0 to never do less.
    trials_max : int
        Leaves that are cut in one frame to try a split; 0 for no limit to what is tried again.
    every_surface : bool
        Whether every segment that was cut gets a surface in every frame, as in files, or only in turn.

    Raises
    ------
    TypeError
        If the configuration is something else.
    ValueError
        If `trials_max` is negative.
    """

    def __init__(
        self,
        config: SegmentationConfig | None = None,
        *,
        temporal: bool = True,
        target_hz: float = 0.0,
        trials_max: int = TRIALS_MAX,
        every_surface: bool = False,
    ) -> None:
        self.config = config = _checked(config)
        if trials_max < 0:
            raise ValueError(f"trials_max: expected at least 0, got {trials_max}")
        self._every_surface = every_surface
        self._budget = Budget(trials=trials_max) if trials_max else UNLIMITED
        self._rate_controller = RateController(target_hz, self._budget) if target_hz > 0 else None
        self._temporal = temporal
        noise = config.extended.inverse_depth_noise
        self._tracker = cache(partial(new_tracker, noise)) if temporal else None
        self._registration = Registration()
        self._live = LiveTree(config) if temporal and supports_live_tree(config) else None
        self._surfaces: Identities | None = None
        self._objects: Identities | None = None
        self._object_of_label = np.zeros(1, dtype=np.uint16)
        self._jumps: int | None = None

    def restart(self, reason: str) -> None:
        """Segment the next frame from scratch; segments found again keep their identities."""
        if self._live is not None:
            self._live.restart(reason)

    def process(self, frame: RGBDFrame, *, source_hz: float = 0.0, waited_ms: float = 0.0) -> FrameResult:
        """Register and segment a frame.

        Parameters
        ----------
        frame : RGBDFrame
            Depth and color.
        source_hz : float
            Frame rate of the source, which limits the target; 0 if unknown.
        waited_ms : float
            Time that the frame has waited since its arrival; a late frame is updated less.

        Returns
        -------
        FrameResult
            With the stages of `process_frame` and, if frames continue each other, ``identify``.

        Raises
        ------
        TypeError
            If the frame is something else.
        """
        check_frame(frame)
        if self._live is None:
            result = process_frame(frame, self.config, self._registration)
            return self._identified(result, None) if self._temporal else result
        live = self._live
        if self._jumps not in (None, frame.jumps):
            self.restart("a jump to another frame")
        self._jumps = frame.jumps
        budget = self._budget
        if self._rate_controller is not None:
            budget = self._rate_controller.budget(waited_ms)
        segment_live = partial(
            live.segment, budget=budget, frame=frame.index, every_surface=self._every_surface
        )
        result = _segmented(frame, segment_live, self._registration, self.config)
        result = replace(result, update=live.report)
        cold = bool(live.report.reset)
        result = self._identified(result, None if cold else live.labels_before)
        if self._rate_controller is not None:
            self._rate_controller.took(sum(result.elapsed_ms.values()), source_hz=source_hz, cold=cold)
        return result

    def _identified(self, result: FrameResult, before: NDArray[np.uint16] | None) -> FrameResult:
        """Give segments the identities of those that they continue.

        `before` holds the labels of the previous frame's leaves at their present positions, if known.
        """
        started_s = time.perf_counter()
        tree = result.tree
        labels = tree.labels("surfaces")
        self._surfaces = track_identities(self._surfaces, labels, result.cloud, before=before)
        object_of_label = result.object_of_leaf if tree.objects else np.zeros_like(result.surface_of_leaf)
        if tree.objects:
            objects = None if before is None else apply_lookup_table(self._object_of_label, before)
            self._objects = track_identities(
                self._objects, apply_lookup_table(object_of_label, labels), result.cloud, before=objects
            )
        self._object_of_label = object_of_label
        elapsed_ms = {**result.elapsed_ms, "identify": 1e3 * (time.perf_counter() - started_s)}
        return replace(
            result,
            elapsed_ms=elapsed_ms,
            surface_identities=self._surfaces,
            object_identities=self._objects if tree.objects else None,
            tracker=self._tracker,
        )


def process_frame(
    frame: RGBDFrame, config: SegmentationConfig | None = None, registration: Registration | None = None
) -> FrameResult:
    """Register and segment one frame.

    Parameters
    ----------
    frame : RGBDFrame
        Depth and color.
    config : SegmentationConfig, optional
        Settings of the segmentation.
    registration : Registration, optional
        That of the frames before, so that nothing is prepared again for the same calibration.

    Returns
    -------
    FrameResult
        With the stages ``register`` and ``segment``.

    Raises
    ------
    TypeError
        If the frame or the configuration is something else.
    """
    check_frame(frame)
    config = _checked(config)
    return _segmented(frame, partial(segment, config=config), registration or Registration(), config)


def _checked(config: SegmentationConfig | None) -> SegmentationConfig:
    if config is not None and not isinstance(config, SegmentationConfig):
        example = 'SegmentationConfig(method="stag15")'
        raise TypeError(f"config: expected settings such as {example}, got {config!r}")
    return config or SegmentationConfig()


def _segmented(
    frame: RGBDFrame,
    segment: Callable[[PointMap], SegmentationTree],
    registration: Registration,
    config: SegmentationConfig,
) -> FrameResult:
    started_s = time.perf_counter()
    cloud = registration.register(frame)
    registered_s = time.perf_counter()
    tree = segment(cloud)
    elapsed_ms = {
        "register": 1e3 * (registered_s - started_s),
        "segment": 1e3 * (time.perf_counter() - registered_s),
    }
    return FrameResult(frame, cloud, tree, elapsed_ms, config=config)


class RateController:
    """Chooses the step of the grid that maintains a frame rate.

    `level` is by how many pixels it exceeds the usual one, 0 or 1: two would save another 5 % of a frame, and
    cost .01 GTRC in clutter. `budget`, that of a frame on time, stays: postponed updates of the tree add up
    to a frame that is segmented from scratch, which costs more.
    """

    def __init__(self, target_hz: float, budget: Budget | None = None) -> None:
        if not target_hz > 0:
            raise ValueError(f"target_hz: expected more than 0, got {target_hz}")
        self.level = 0
        self._target_hz = target_hz
        self._budget = budget or Budget()
        self._took_ms: deque[float] = deque(maxlen=_SUSTAINED)
        self._since = 0
        self._brief = 0
        # Time per frame before the last change, and the factor of the finer grid.
        self._before_ms, self._finer_costs = 0.0, 1.0
        self._is_compared = True

    def budget(self, waited_ms: float = 0.0) -> Budget:
        """Return the budget of the next frame, which has waited so long for the one before it.

        Updates of a late frame are put off for a few frames, so that the delay does not last.
        """
        late = waited_ms > _LATE * 1e3 / self._target_hz
        brief = late and self._brief < _BRIEF_MOST
        self._brief = self._brief + 1 if brief else max(0, self._brief - (not late))
        return replace(_BRIEF if brief else self._budget, coarser=self.level)

    def took(self, frame_ms: float, *, source_hz: float = 0.0, cold: bool = False) -> None:
        """Consider the time from taking a frame to its labels.

        `source_hz` is the rate of the source, 0 if unknown, above which there is nothing to gain. A `cold`
        frame was segmented from scratch and predicts nothing.
        """
        self._since += 1
        if cold:
            return
        self._took_ms.append(frame_ms)
        if len(self._took_ms) < _DOWN_AFTER:
            return
        hz = min(self._target_hz, source_hz or self._target_hz)
        period_ms = 1e3 / hz
        # The median ignores single slow frames.
        usual_ms = statistics.median(islice(reversed(self._took_ms), _FRAMES))
        full = len(self._took_ms) >= _FRAMES
        # The first frames take a little longer, which is no reason to change.
        if not (full or self._before_ms or usual_ms > _HOPELESS * period_ms):
            return
        # A scene can be rich for a second; while the rate holds, only what lasts is a reason.
        lasts = len(self._took_ms) == _SUSTAINED and statistics.median(self._took_ms) > _FULL * period_ms
        limit = _FULL if lasts or not full else 1.0
        costs_too_much = usual_ms > limit * period_ms and not self.level
        if not self._is_compared and (full or costs_too_much):
            finer_ms, coarser_ms = sorted((usual_ms, self._before_ms), reverse=True)
            self._finer_costs = finer_ms / coarser_ms
            self._is_compared = True
        finer_ms = usual_ms * (self._finer_costs if self._since < _FORGET_AFTER else 1.0)
        if costs_too_much:
            self._change(1, usual_ms, hz)
        elif self.level and self._since >= _UP_AFTER and finer_ms < _SPARE * period_ms:
            self._change(0, usual_ms, hz)

    def _change(self, level: int, usual_ms: float, hz: float) -> None:
        self.level, self._since, self._before_ms, self._is_compared = level, 0, usual_ms, False
        self._took_ms.clear()
        _log.info(
            "%s to hold %.3g frames/s (a frame took %.0f ms): the grid's step is %s",
            "doing less" if level else "doing more",
            hz,
            usual_ms,
            "1 px more than usual" if level else "as usual",
        )
