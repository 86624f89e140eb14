"""The transforms between the frames of a recording, and those that follow from them."""

from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError
from nurbseg.common.limits import TRANSFORMS_BYTES_MAX
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.messages import Messages

#: The names of two frames, parent and child, and the (4, 4) parent_from_child.
Transform = tuple[str, str, NDArray[np.float64]]
#: Farther translations are ignored, meters.
_FAR_M = 1e6


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
