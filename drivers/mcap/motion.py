"""The camera's pose and the direction of gravity, of recordings that hold them beside their images."""

from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError
from nurbseg.common.frame import Calibration
from nurbseg.drivers.gravity import gravity_of
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.cameras import FindTransform
from nurbseg.drivers.mcap.pairing import Beside, StampedPair
from nurbseg.drivers.mcap.topics import TopicSample
from nurbseg.drivers.mcap.transforms import transforms_of

#: An acceleration farther from the image than this says nothing of it, nanoseconds.
_NEAR_NS = 100_000_000


class RecordedMotion:
    """Finds the pose and the gravity of each frame of a recording.

    Poses are read from our own recordings, whose `/tf` has one for each frame; gravity from the first topic
    of an accelerometer (sensor_msgs/Imu) of the camera, if a transform leads to it.
    """

    def __init__(
        self, depth_topic: str, samples: Mapping[str, TopicSample], find: FindTransform, *, is_ours: bool
    ) -> None:
        self._is_ours = is_ours
        self._pose_topic = ros.POSE_TOPIC if is_ours and ros.POSE_TOPIC in samples else None
        depth = samples[depth_topic]
        #: The frame of the color camera beside, which poses are of.
        self._color_frame = depth.frame.replace("depth", "color")
        self._imu_topic: str | None = None
        self._depth_from_imu = np.eye(3)
        # A gyroscope alone, as RealSense has it, shows no acceleration.
        accelerometers = (
            sample
            for topic, sample in sorted(samples.items())
            if sample.schema == ros.IMU and "gyro" not in topic.lower() and sample.camera == depth.camera
        )
        for imu in islice(accelerometers, 1):
            turn = np.eye(4) if imu.frame == depth.frame else find(depth.frame, imu.frame)
            if turn is not None:
                self._imu_topic, self._depth_from_imu = imu.topic, turn[:3, :3]

    @property
    def topics(self) -> set[str]:
        """The topics that are read."""
        return {each for each in (self._pose_topic, self._imu_topic) if each is not None}

    def pose(self, beside: Beside, pair: StampedPair, calibration: Calibration) -> NDArray[np.float64] | None:
        """Return the (4, 4) world_from_camera of a frame; None where it is not known."""
        message = _decoded(beside, self._pose_topic, pair, ros.TRANSFORMS)
        if message is None or not message.transforms or _stamp_of(message.transforms[0]) != pair.time_ns:
            return None
        for parent, child, world_from_color in transforms_of(message):
            if (parent, child) == (ros.WORLD_FRAME, self._color_frame):
                return np.asarray(world_from_color @ calibration.color_from_depth, dtype=np.float64)
        return None

    def gravity(self, beside: Beside, pair: StampedPair) -> NDArray[np.float64] | None:
        """Return the (3,) direction of gravity in the depth camera's frame; None where it is not known."""
        message = _decoded(beside, self._imu_topic, pair, ros.IMU)
        limit_ns = 0 if self._is_ours else _NEAR_NS
        if message is None or abs(_stamp_of(message) - pair.time_ns) > limit_ns:
            return None
        shown = message.linear_acceleration
        return gravity_of(np.array([shown.x, shown.y, shown.z], dtype=np.float64), self._depth_from_imu)


def _decoded(beside: Beside, topic: str | None, pair: StampedPair, schema: str) -> Any:
    """Return the message of a topic that was logged nearest to a depth image; None if there is none."""
    content = beside.near(topic, pair.log_ns)
    with suppress(FrameFormatError):
        return content and ros.decode(content, schema, str(topic))
    return None


def _stamp_of(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
