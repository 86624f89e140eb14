"""Frame after frame: what is known of the last one is carried into the next."""

from __future__ import annotations

import time
from dataclasses import replace
from types import MappingProxyType

from nurbseg.app.worker import FrameResult, process_frame
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.identity import Identities, carry_identities


class Segmenter:
    """Segments frame after frame.

    Parameters
    ----------
    config : SegmentationConfig
        How to segment.
    temporal : bool
        Whether a frame continues the one before: segments keep their identities.
    """

    def __init__(self, config: SegmentationConfig, *, temporal: bool) -> None:
        self._config = config
        self._temporal = temporal
        self._surfaces: Identities | None = None
        self._objects: Identities | None = None

    def process(self, frame: RGBDFrame) -> FrameResult:
        """Register and segment a frame.

        Parameters
        ----------
        frame : RGBDFrame
            Depth and color.

        Returns
        -------
        FrameResult
            With the stages of `process_frame` and, where frames continue each other, ``identify``.
        """
        result = process_frame(frame, self._config)
        return self._identified(result) if self._temporal else result

    def _identified(self, result: FrameResult) -> FrameResult:
        """Give the segments of a frame the identities of those that they continue."""
        started_s = time.perf_counter()
        tree = result.tree
        self._surfaces = carry_identities(self._surfaces, tree.label_image(), result.cloud)
        if tree.objects:
            self._objects = carry_identities(self._objects, tree.object_image(), result.cloud)
        elapsed_ms = {**result.elapsed_ms, "identify": 1e3 * (time.perf_counter() - started_s)}
        return replace(
            result,
            elapsed_ms=MappingProxyType(elapsed_ms),
            surface_identities=self._surfaces,
            object_identities=self._objects if tree.objects else None,
        )
