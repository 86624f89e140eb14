"""The accelerometer of a RealSense, which says where down is."""

import logging
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.gravity import gravity_of
from nurbseg.drivers.realsense import sdk

logger = logging.getLogger(__name__)

#: Readings that the SDK keeps for us: those of a frame are at most 14.
_QUEUED = 64
#: A reading counts for so long, seconds, if no other comes.
_KEPT_S = 0.1


class Accelerometer:
    """Reads the accelerometer of an open device, if it has one that states how it lies.

    Attributes
    ----------
    streaming : list
        Its sensor, which whoever owns the device stops and closes; empty without one.
    """

    def __init__(self, rs: Any, device: Any, depth: Any, name: str) -> None:
        self.streaming: list[Any] = []
        self._queue = rs.frame_queue(_QUEUED)
        self._gravity: NDArray[np.float64] | None = None
        self._read_s = -np.inf
        found = sdk.accelerometer(rs, device, depth)
        if found is None:
            return
        sensor, profile, self._depth_from_sensor = found
        try:
            sensor.open(profile)
            self.streaming.append(sensor)
            sensor.start(self._queue)
        except RuntimeError as err:
            # On Linux its files often lack a udev rule, while the cameras work.
            logger.warning(
                "%s: its accelerometer cannot be started (%s); where down is, is not known", name, err
            )

    def gravity(self) -> NDArray[np.float64] | None:
        """Return where down is in the depth camera's frame, by the readings since the last call."""
        readings = []
        while frame := self._queue.poll_for_frame():
            reading = frame.as_motion_frame().get_motion_data()
            readings.append((reading.x, reading.y, reading.z))
        if readings:
            self._gravity = gravity_of(np.mean(readings, axis=0), self._depth_from_sensor)
            self._read_s = time.monotonic()
        return self._gravity if time.monotonic() - self._read_s < _KEPT_S else None
