"""How a recording's camera moves: transforms between frames, poses, and the direction of gravity."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError
from nurbseg.common.frame import Calibration
from nurbseg.common.limits import TRANSFORMS_BYTES_MAX
from nurbseg.drivers.gravity import gravity_of
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.messages import Messages
from nurbseg.drivers.mcap.pairing import Beside, StampedPair
from nurbseg.drivers.mcap.topics import TopicSample

#: The names of two frames, parent and child, and the (4, 4) parent_from_child.
Transform = tuple[str, str, NDArray[np.float64]]
#: Farther translations are ignored, meters.
_FAR_M = 1e6
#: Finds the (4, 4) target_from_source of two frames; None where the recording does not say.
FindTransform = Callable[[str, str], NDArray[np.float64] | None]
#: An acceleration farther from the image than this says nothing of it, nanoseconds.
_NEAR_NS = 100_000_000


class Transforms:
    """Finds transforms by the messages of some topics, anywhere in the files; reads them when needed.

    Static ones come first. A transform that changes counts as it was at first.
    """

    def __init__(self, messages: Messages, topics: Iterable[str]) -> None:
        self._messages, self._topics = messages, list(topics)
        self._read = cache(self._read_topics)

    def find(self, target: str, source: str) -> NDArray[np.float64] | None:
        """Return the (4, 4) target_from_source; None if the recording does not say it."""
        static = self._read(static=True)
        found = _chained(target, source, static)
        return _chained(target, source, static + self._read(static=False)) if found is None else found

    def _read_topics(self, *, static: bool) -> list[Transform]:
        found: dict[tuple[str, str], Transform] = {}
        left = TRANSFORMS_BYTES_MAX
        for topic in self._topics:
            for item in self._messages.messages([topic]) if topic.endswith("tf_static") == static else ():
                if isinstance(item, FrameFormatError):
                    continue
                left -= len(item.content)
                if left < 0:
                    return list(found.values())
                with suppress(FrameFormatError):
                    message = ros.decode(item.content, ros.TRANSFORMS, str(self._messages.path))
                    for transform in transforms_of(message):
                        found.setdefault(transform[:2], transform)
        return list(found.values())


def transforms_of(message: Any) -> list[Transform]:
    """Return the transforms of a tf2_msgs/TFMessage."""
    from scipy.spatial.transform import Rotation

    found = []
    for transform in message.transforms:
        place, turn = transform.transform.translation, transform.transform.rotation
        quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
        matrix = np.eye(4)
        matrix[:3, 3] = [place.x, place.y, place.z]
        # Translations and quaternions out of range are ignored; they might also overflow.
        if not np.abs(matrix[:3, 3]).max() < _FAR_M or not 1e-3 < np.abs(quaternion).max() < 1e3:
            continue
        matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        parent, child = transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")
        found.append((parent, child, matrix))
    return found


def _chained(target: str, source: str, transforms: list[Transform]) -> NDArray[np.float64] | None:
    """Return target_from_source, chained from transforms of parents and children; None if there is none."""
    steps: dict[str, list[tuple[str, NDArray[np.float64]]]] = {}
    for parent, child, matrix in transforms:
        steps.setdefault(child, []).append((parent, matrix))
        steps.setdefault(parent, []).append((child, np.asarray(np.linalg.inv(matrix), dtype=np.float64)))
    reached = {source: np.eye(4)}
    waiting = [source]
    while waiting:
        frame = waiting.pop()
        for other, other_from_frame in steps.get(frame, []):
            if other not in reached:
                reached[other] = other_from_frame @ reached[frame]
                waiting.append(other)
    return reached.get(target)


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
