"""Bags of ROS 1 (``.bag``), read by the library rosbags."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nurbseg.common.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import open_regular
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.messages import MessageFile, Stored, Topic

#: ROS 1 knew transforms by two names.
_RENAMED = {"tf/msg/tfMessage": ros.TRANSFORMS}


class Ros1File(MessageFile):
    """A bag of ROS 1, opened for reading; its messages are converted to those of ROS 2 as they are read.

    Only the message types of `ros_messages` are converted, and by fixed definitions: none of a file's own is
    registered. Raises RecordingFormatError if it is no such bag, or has no index, as one that was not closed.
    """

    form = "ROS 1 bag"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._types = get_typestore(Stores.ROS2_HUMBLE)
        # The library has none of its package.
        text = "geometry_msgs/TransformStamped[] transforms"
        self._types.register(get_types_from_msg(text, ros.TRANSFORMS))
        open_regular(path).close()
        self._bag: Any = Reader(path)
        try:
            self._bag.open()
        # The library raises errors of many kinds for a damaged index, and asserts.
        except Exception as err:
            remedy = f"; rosbag reindex {path} makes an index" if "not indexed" in str(err) else ""
            what = f"the ROS 1 bag cannot be read ({quoted(str(err))}){remedy}"
            raise RecordingFormatError(f"{path}: {what}") from err
        for connection in self._bag.connections:
            name, topic = _RENAMED.get(connection.msgtype, connection.msgtype), connection.topic
            # RealSense's SDK wrote such bags until 2025; their cameras are in messages of its own.
            if topic.startswith("/device_0/sensor_"):
                self.close()
                convert = f"rs.context().convert_bag_to_db3('{path}', '{path.with_suffix('.db3')}')"
                raise RecordingFormatError(
                    f"{path}: a recording of an older RealSense SDK; convert it: "
                    f'python -c "import pyrealsense2 as rs; {convert}"'
                )
            if connection.msgcount:
                before = self.topics[topic].messages if topic in self.topics else 0
                self.topics[topic] = Topic(name, "cdr", before + connection.msgcount)
        self._indexes = dict(self._bag.indexes)
        self.span_ns = self._bag.duration if self._bag.chunk_infos else 0

    def close(self) -> None:
        """Close the file; safe to call twice."""
        if self._bag.bio is not None:
            self._bag.close()

    def _of_topic(self, topic: str, after: tuple[int, int] | None) -> Iterator[Stored]:
        connections = {each.id: each for each in self._bag.connections if each.topic == topic}
        # The library has them in the order of time.
        entries = sorted(
            ((entry.chunk_pos, entry.offset), number, entry)
            for number in connections
            for entry in self._indexes[number]
        )
        kind = self.topics[topic].schema
        for place, number, entry in entries:
            if after is not None and place <= after:
                continue
            try:
                self._bag.indexes[number] = [entry]
                _, log_ns, raw = next(self._bag.messages([connections[number]]))
                content = bytes(self._types.ros1_to_cdr(raw, kind)) if kind in ros.DEFINITIONS else raw
                yield Stored(place, log_ns, content)
            except Exception as err:  # The library raises errors of many kinds for damage.
                text = f"{self.path}: the chunk at byte {place[0]}: damaged ({quoted(str(err))})"
                yield Stored(place, 0, FrameFormatError(text))
