"""Work on one frame that several settings have in common: done once, kept for the next."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any, TypeVar

from nurbseg.segmentation.config import SegmentationConfig

_Made = TypeVar("_Made")


class SharedWork:
    """Keeps what was made for one frame, for settings that would make the very same.

    A cut depends on the segment's name and points, not on the metric that judges it: trees that differ in
    metric, threshold and limits share all the cuts and fits that they both come to. One object serves one
    frame and one thread; it holds on to everything until it is dropped.
    """

    def __init__(self) -> None:
        self._made: dict[Hashable, Any] = {}
        self._latest: tuple[SegmentationConfig, SegmentationConfig] | None = None

    def once(self, config: SegmentationConfig, name: Hashable, make: Callable[[], _Made]) -> _Made:
        """Return what is kept under a name for settings like these; make and keep it the first time.

        Parameters
        ----------
        config : SegmentationConfig
            Its metric, thresholds and limits of the tree do not count.
        name : hashable
            What it is.
        make : callable
            Makes it.
        """
        if self._latest is None or self._latest[0] is not config:
            alike = replace(config, metric="mse", ratio_max=1.0, depth_max=0, splits_max=0)
            self._latest = config, alike
        key = (self._latest[1], name)
        if key not in self._made:
            self._made[key] = make()
        made: _Made = self._made[key]
        return made
