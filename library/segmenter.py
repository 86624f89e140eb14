"""Segmentation of single frames, and of sequences, in which each frame continues the previous one."""

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import RGBDFrame, check_frame
from nurbseg.library.rate_controller import RateController
from nurbseg.library.result import FrameResult, new_tracker
from nurbseg.segmentation.config import TRIALS_MAX, SegmentationConfig
from nurbseg.segmentation.live.identity import NEW_SEQUENCE, Identities, track_identities
from nurbseg.segmentation.live.tree import UNLIMITED, Budget, LiveTree, supports_live_tree
from nurbseg.segmentation.points.registration import PointMap, Registration
from nurbseg.segmentation.segments import SegmentationTree

_log = logging.getLogger(__name__)


class Segmenter:
    """Segments a sequence of frames.

    A frame that was interrupted leaves it usable: the next one is segmented from scratch.

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
        self._tracker = cache(partial(new_tracker, config)) if temporal else None
        self._registration = Registration()
        self._live = LiveTree(config) if temporal and supports_live_tree(config) else None
        self._surfaces: Identities | None = None
        self._objects: Identities | None = None
        self._object_of_label = np.zeros(1, dtype=np.uint16)
        #: Jumps, number and stamp of the frame before, and whether they never went back.
        self._before: tuple[int, int, int] | None = None
        self._is_first_sequence = True
        self._busy = Lock()
        #: Whether the last frame was interrupted, so that what is kept of it may be of two frames.
        self._unfinished = False

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
        RuntimeError
            If another thread is in the middle of a frame.
        """
        check_frame(frame)
        if not self._busy.acquire(blocking=False):
            raise RuntimeError("this Segmenter is used by another thread: make one for each")
        try:
            if self._unfinished and self._live is not None:
                self._live = LiveTree(self.config)
                self._live.restart("an interruption")
            interrupted, self._unfinished = self._unfinished, True
            result = self._processed(frame, source_hz, waited_ms, interrupted=interrupted)
            self._unfinished = False
        finally:
            self._busy.release()
        return result

    def _processed(
        self, frame: RGBDFrame, source_hz: float, waited_ms: float, *, interrupted: bool
    ) -> FrameResult:
        """Register and segment a frame; `interrupted` if the one before was not finished."""
        if self._live is None:
            result = process_frame(frame, self.config, self._registration)
            return self._identified(result, None) if self._temporal else result
        live = self._live
        before, self._before = self._before, (frame.jumps, frame.index, frame.timestamp_ns)
        if before is not None and before[0] != frame.jumps:
            self.restart("a jump to another frame")
        elif before is not None and (frame.index < before[1] or frame.timestamp_ns < before[2]):
            self.restart(NEW_SEQUENCE)
            if self._is_first_sequence:
                self._is_first_sequence = False
                _log.warning(
                    "frame %d: %s; here and from now on, a new sequence begins", frame.index, NEW_SEQUENCE
                )
        budget = self._budget
        if self._rate_controller is not None:
            budget = self._rate_controller.budget(waited_ms)
        segment_live = partial(
            live.segment, budget=budget, frame=frame.index, every_surface=self._every_surface
        )
        result = _segmented(frame, segment_live, self._registration, self.config)
        result = replace(result, update=live.report)
        cold = bool(live.report.reset)
        result = self._identified(result, None if interrupted else live.labels_before)
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
            wholes = object_of_label, self._object_of_label
            self._objects = track_identities(
                self._objects, labels, result.cloud, before=before, wholes=wholes
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
    from nurbseg.segmentation.methods import segment  # late: a live tree calls the stages itself

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
