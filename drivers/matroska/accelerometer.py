"""The accelerometer's readings in a recording of k4arecorder."""

import os
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.gravity import gravity_of
from nurbseg.drivers.matroska.listing import Track

#: A reading as the recorder writes it: accelerometer and gyroscope, each with its time.
_READING = np.dtype([("ns", "<u8"), ("m_s2", "<f4", 3), ("gyro_ns", "<u8"), ("rad_s", "<f4", 3)])
#: Readings of a block are at most so many, since one byte counts them.
_READINGS_MAX = 256
#: A block farther from an image than this says nothing of it, nanoseconds.
_NEAR_NS = 100_000_000


class RecordedAccelerometer:
    """Finds the direction of gravity at a time.

    Parameters
    ----------
    track : Track
        Its blocks hold one reading or, laced, several.
    depth_from_sensor : (3, 3) float64
        Turn from the accelerometer's axes to those of the depth camera.
    """

    def __init__(self, track: Track, depth_from_sensor: NDArray[np.float64]) -> None:
        self._blocks = track.sorted_blocks()
        self._turn = depth_from_sensor

    def gravity(self, stream: BinaryIO, time_ns: int) -> NDArray[np.float64] | None:
        """Return the direction at a time of the blocks; None where no reading is near and usable."""
        times = self._blocks[:, 0]
        after = int(np.searchsorted(times, time_ns))
        near = [n for n in (after - 1, after) if 0 <= n < times.size]
        near.sort(key=lambda n: abs(int(times[n]) - time_ns))
        if not near or abs(int(times[near[0]]) - time_ns) > _NEAR_NS:
            return None
        start, end = self._blocks[near[0], 1:].tolist()
        content = os.pread(stream.fileno(), min(end - start, 2 * _READINGS_MAX * _READING.itemsize), start)
        # What laces readings together is a few bytes in front of them.
        count = len(content) // _READING.itemsize
        readings = np.frombuffer(content, _READING, count, len(content) - count * _READING.itemsize)
        mean = readings["m_s2"].mean(axis=0, dtype=np.float64) if count else np.zeros(3)
        return gravity_of(mean, self._turn)
