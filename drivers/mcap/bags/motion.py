"""The camera's pose and the direction of gravity, as a recording holds them beside its images."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.drivers.gravity import STANDARD_GRAVITY, gravity_of
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.cameras import FindTransform
from nurbseg.drivers.mcap.container.timeline import Timeline
from nurbseg.drivers.mcap.pairing import StampedPair
from nurbseg.drivers.mcap.topics import TopicSample, camera_name, frame_of

#: Of our own recordings.
POSE_TOPIC, IMU_TOPIC = "/tf", "/camera/imu"
WORLD_FRAME = "world"

#: An acceleration farther from the image than this says nothing of it, nanoseconds.
_NEAR_NS = 100_000_000


def motion_messages(
    frame: RGBDFrame, color_frame: str, depth_frame: str
) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield topic, schema and message of what a frame says of the camera's motion.

    The pose is that of the color camera, which is above the depth camera in the tree of transforms.
    """
    stamp = frame.timestamp_ns
    if frame.world_from_camera is not None:
        world_from_color = frame.world_from_camera @ np.linalg.inv(frame.calibration.color_from_depth)
        message = ros.transform_message(stamp, WORLD_FRAME, color_frame, world_from_color)
        yield POSE_TOPIC, ros.TRANSFORMS, message
    if frame.gravity is not None:
        # An accelerometer at rest shows what holds it up. A covariance of -1 says that a value is not known.
        unknown = [-1.0] + [0.0] * 8
        x, y, z = (-STANDARD_GRAVITY * frame.gravity).tolist()
        zero = {"x": 0.0, "y": 0.0, "z": 0.0}
        yield (
            IMU_TOPIC,
            ros.IMU,
            {
                "header": ros.header(stamp, depth_frame),
                "orientation": {**zero, "w": 1.0},
                "orientation_covariance": unknown,
                "angular_velocity": zero,
                "angular_velocity_covariance": unknown,
                "linear_acceleration": {"x": x, "y": y, "z": z},
                "linear_acceleration_covariance": [0.0] * 9,
            },
        )


class RecordedMotion:
    """Finds the pose and the gravity of each frame of a recording.

    Poses are read from our own recordings, whose `/tf` has one for each frame; gravity from the first topic
    of an accelerometer (sensor_msgs/Imu) of the camera, if a transform leads to it.
    """

    def __init__(
        self, depth_topic: str, samples: Mapping[str, TopicSample], find: FindTransform, *, is_ours: bool
    ) -> None:
        self._is_ours = is_ours
        self._pose_topic = POSE_TOPIC if is_ours and POSE_TOPIC in samples else None
        #: The frame of the color camera beside, which poses are of.
        self._color_frame = frame_of(samples[depth_topic]).replace("depth", "color")
        name = camera_name(depth_topic)
        self._imu_topic = next(
            (
                accelerometer
                for accelerometer in _accelerometers(samples)
                if camera_name(accelerometer) == name
            ),
            None,
        )
        self._depth_from_imu: NDArray[np.float64] | None = None
        if self._imu_topic is not None:
            frames = frame_of(samples[depth_topic]), frame_of(samples[self._imu_topic])
            turn = np.eye(4) if frames[0] == frames[1] else find(*frames)
            if turn is None:
                self._imu_topic = None
            else:
                self._depth_from_imu = turn[:3, :3]

    @property
    def topics(self) -> set[str]:
        """The topics that are read."""
        return {each for each in (self._pose_topic, self._imu_topic) if each is not None}

    def at(
        self, timeline: Timeline, pair: StampedPair, calibration: Calibration
    ) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
        """Return world_from_camera and gravity of a frame, each None where it is not known."""
        return self._pose(timeline, pair, calibration), self._gravity(timeline, pair)

    def _pose(
        self, timeline: Timeline, pair: StampedPair, calibration: Calibration
    ) -> NDArray[np.float64] | None:
        for message in _near(timeline, self._pose_topic, pair, ros.TRANSFORMS):
            if not message.transforms or _stamp_of(message.transforms[0]) != pair.stamp_ns:
                continue
            for parent, child, world_from_color in ros.transforms_of(message):
                if (parent, child) == (WORLD_FRAME, self._color_frame):
                    return np.asarray(world_from_color @ calibration.color_from_depth, dtype=np.float64)
        return None

    def _gravity(self, timeline: Timeline, pair: StampedPair) -> NDArray[np.float64] | None:
        found = list(_near(timeline, self._imu_topic, pair, ros.IMU))
        if not found or self._depth_from_imu is None:
            return None
        nearest = min(found, key=lambda each: abs(_stamp_of(each) - pair.stamp_ns))
        if abs(_stamp_of(nearest) - pair.stamp_ns) > (0 if self._is_ours else _NEAR_NS):
            return None
        shown = nearest.linear_acceleration
        return gravity_of(np.array([shown.x, shown.y, shown.z], dtype=np.float64), self._depth_from_imu)


def _accelerometers(samples: Mapping[str, TopicSample]) -> Sequence[str]:
    """Return the topics of accelerometers; a gyroscope alone, as RealSense has it, shows no acceleration."""
    topics = [topic for topic, sample in samples.items() if sample.schema == ros.IMU]
    return sorted(topic for topic in topics if "gyro" not in topic.lower())


def _near(timeline: Timeline, topic: str | None, pair: StampedPair, schema: str) -> Iterator[Any]:
    """Yield the messages of a topic just before and after a depth image."""
    if topic is None:
        return
    numbers = timeline.numbers(topic)
    after = int(np.searchsorted(numbers, pair.number))
    for item in timeline.messages(numbers[max(0, after - 1) : after + 1]):
        if isinstance(item, FrameFormatError):
            continue
        try:
            yield ros.decode(item.message.data, schema, topic)
        except FrameFormatError:
            continue


def _stamp_of(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
