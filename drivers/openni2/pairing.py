"""Pairs depth and color images by the device's time."""

from __future__ import annotations

from nurbseg.drivers.openni2.capi import Sensor
from nurbseg.drivers.openni2.stream import Image


class Pairing:
    """Keeps what waits for its other half; `half_pairs` counts what was given up because that never came."""

    def __init__(self, limit_us: int) -> None:
        self._limit_us = limit_us
        self._waiting: dict[Sensor, Image] = {}
        self.half_pairs = 0

    def clear(self) -> None:
        """Forget what waits: its other half will not come."""
        self._waiting.clear()

    def add(self, sensor: Sensor, image: Image) -> tuple[Image, Image] | None:
        """Take an image in; return the pair of depth and color that it completes, if it does."""
        self.half_pairs += sensor in self._waiting
        self._waiting[sensor] = image
        if len(self._waiting) < 2:
            return None
        depth, color = self._waiting[Sensor.DEPTH], self._waiting[Sensor.COLOR]
        ahead_us = depth.timestamp_us - color.timestamp_us
        if abs(ahead_us) <= self._limit_us:
            self._waiting.clear()
            return depth, color
        # The other half of the older one can no longer come.
        self.half_pairs += 1
        del self._waiting[Sensor.COLOR if ahead_us > 0 else Sensor.DEPTH]
        return None
