"""Pairs depth and color images by the device's time."""

from __future__ import annotations

from nurbseg.drivers.openni2.stream import Image


class Pairing:
    """Keeps what waits for its other half; `half_pairs` counts what was given up because that never came."""

    def __init__(self, limit_us: int) -> None:
        self._limit_us = limit_us
        self._depth: Image | None = None
        self._color: Image | None = None
        self.half_pairs = 0

    def clear(self) -> None:
        """Forget what waits: its other half will not come."""
        self._depth = self._color = None

    def add_depth(self, image: Image) -> tuple[Image, Image] | None:
        """Take a depth image in; return the pair that it completes, if it does."""
        self.half_pairs += self._depth is not None
        self._depth = image
        return self._match()

    def add_color(self, image: Image) -> tuple[Image, Image] | None:
        """Take a color image in; return the pair that it completes, if it does."""
        self.half_pairs += self._color is not None
        self._color = image
        return self._match()

    def _match(self) -> tuple[Image, Image] | None:
        depth, color = self._depth, self._color
        if depth is None or color is None:
            return None
        ahead_us = depth.timestamp_us - color.timestamp_us
        if abs(ahead_us) <= self._limit_us:
            self._depth = self._color = None
            return depth, color
        # The other half of the older one can no longer come.
        self.half_pairs += 1
        if ahead_us > 0:
            self._color = None
        else:
            self._depth = None
        return None
