"""Reads a bag of ROS 1 (``.bag``) by the library rosbags."""

import bz2
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
from mcap.records import Channel, Message, Schema

from nurbseg.common.errors import BackendMissingError, FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import open_regular
from nurbseg.common.limits import CHUNK_BYTES_MAX, MESSAGES_MAX
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.bag import MessageFile, Run

#: ROS 1 knew transforms by two names.
_RENAMED = {"tf/msg/tfMessage": ros.TRANSFORMS}
#: Topics of the recordings that RealSense's SDK wrote until 2025.
_REALSENSE = "/device_0/sensor_"
_LENGTH = struct.Struct("<I")
_OPS_CONTENT = 2
#: Bytes of a message's head.
_HEAD_MAX = 4096


class Ros1File(MessageFile):
    """A bag of ROS 1, opened for reading.

    An entry is a chunk, and messages are converted to those of ROS 2 as they are read. Raises
    BackendMissingError if rosbags is not installed, and RecordingFormatError if it is no such bag, or has no
    index, as one that was not closed.
    """

    form = "ROS 1 bag"

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.rosbag1 import Reader
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as err:
            raise BackendMissingError(
                f"{path}: a bag of ROS 1 is read by rosbags: pip install 'nurbseg[bags]'"
            ) from err
        super().__init__(path)
        self._types = get_typestore(Stores.ROS2_HUMBLE)
        written = get_typestore(Stores.ROS1_NOETIC)
        for store in (self._types, written):
            # The library has none of their package.
            for name in (ros.TRANSFORMS, *_RENAMED):
                store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
        #: The last chunk that was read, which the next message is likely in.
        self._held: tuple[int, bytes] = (-1, b"")
        open_regular(path).close()
        self._bag: Any = Reader(path)
        try:
            self._bag.open()
        # The library raises whatever a damaged index leads it to, and asserts.
        except Exception as err:
            what = f"the ROS 1 bag cannot be read ({quoted(str(err))})"
            if "not indexed" in str(err):
                what += f"; rosbag reindex {path} makes an index"
            raise RecordingFormatError(f"{path}: {what}") from err
        for connection in self._bag.connections:
            name = _RENAMED.get(connection.msgtype, connection.msgtype)
            if connection.topic.startswith(_REALSENSE):
                self.close()
                convert = f"rs.context().convert_bag_to_db3('{path}', '{path.with_suffix('.db3')}')"
                raise RecordingFormatError(
                    f"{path}: a recording of an older RealSense SDK; convert it: "
                    f'python -c "import pyrealsense2 as rs; {convert}"'
                )
            encoding, text = "ros2msg", ros.DEFINITIONS.get(name, "")
            if text and connection.digest not in (
                "*",
                written.generate_msgdef(connection.msgtype, ros_version=1)[1],
            ):
                encoding, text = "ros1msg", connection.msgdef.data
            self.schemas[connection.id] = Schema(
                id=connection.id, name=name, encoding=encoding, data=text.encode()
            )
            self.channels[connection.id] = Channel(
                id=connection.id,
                topic=connection.topic,
                message_encoding="cdr",
                metadata={},
                schema_id=connection.id,
            )

    def close(self) -> None:
        """Close the file; safe to call twice."""
        if self._bag.bio is not None:
            self._bag.close()

    def find_messages(self) -> None:
        """Raise RecordingFormatError if there are too many messages; the bag's index says where they are."""
        if sum(map(len, self._bag.indexes.values())) > MESSAGES_MAX:
            raise RecordingFormatError(f"{self.path}: expected {MESSAGES_MAX} messages at most")

    def runs(self, channel: int) -> Iterator[Run]:
        """Yield the messages of a channel, chunk by chunk."""
        found = np.array(
            [(each.chunk_pos, each.offset, each.time) for each in self._bag.indexes.get(channel, [])],
            np.int64,
        ).reshape(-1, 3)
        for chunk in np.unique(found[:, 0]).tolist():
            own = found[found[:, 0] == chunk]
            yield Run(chunk, own[:, 2], own[:, 1])

    def message(self, entry: int, offset: int) -> Message:
        """Return a message; raises FrameFormatError if it or its chunk is damaged."""
        content = self._chunk(entry)
        name = f"{self.path}: the message at byte {offset} of the chunk at byte {entry}"
        try:
            (head,) = _LENGTH.unpack_from(content, offset)
            fields = _fields(content[offset + 4 : offset + 4 + min(head, _HEAD_MAX)])
            start = offset + 4 + head
            (size,) = _LENGTH.unpack_from(content, start)
            raw = content[start + 4 : start + 4 + size]
            (channel,), (seconds, nanoseconds) = (
                _LENGTH.unpack(fields[b"conn"]),
                struct.unpack("<II", fields[b"time"]),
            )
            if fields[b"op"] != bytes([_OPS_CONTENT]) or len(raw) != size:
                raise ValueError("it is cut off")
            kind = self.schemas[self.channels[channel].schema_id].name
            is_known = kind in ros.DEFINITIONS
            # Raises whatever a damaged message leads it to.
            data = bytes(self._types.ros1_to_cdr(raw, kind)) if is_known else raw
        except Exception as err:
            raise FrameFormatError(f"{name}: the message is damaged ({quoted(str(err))})") from err
        time_ns = seconds * 1_000_000_000 + nanoseconds
        return Message(channel_id=channel, sequence=0, log_time=time_ns, publish_time=time_ns, data=data)

    def _chunk(self, entry: int) -> bytes:
        if entry in self.damaged:
            raise FrameFormatError(self.damaged[entry])
        if self._held[0] != entry:
            try:
                self._held = entry, self._read_chunk(entry)
            except (OSError, EOFError, RuntimeError, ValueError, MemoryError) as err:
                self.damaged[entry] = f"{self.path}: the chunk at byte {entry}: cannot be read ({err})"
                raise FrameFormatError(self.damaged[entry]) from err
        return self._held[1]

    def _read_chunk(self, entry: int) -> bytes:
        chunk, stream = self._bag.chunks[entry], self._bag.bio
        if chunk.datasize > CHUNK_BYTES_MAX:
            raise ValueError(f"{chunk.datasize} bytes; expected {CHUNK_BYTES_MAX} at most")
        stream.seek(chunk.datapos)
        content: bytes = stream.read(chunk.datasize)
        # The library decompresses as much as there is.
        if content.startswith(b"BZh"):
            content = bz2.BZ2Decompressor().decompress(content, max_length=CHUNK_BYTES_MAX + 1)
        elif content.startswith(b"\x04\x22\x4d\x18"):
            content = lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=CHUNK_BYTES_MAX + 1)
        if len(content) > CHUNK_BYTES_MAX:
            raise ValueError(f"over {CHUNK_BYTES_MAX} bytes")
        return content


def _fields(head: bytes) -> dict[bytes, bytes]:
    """Return the fields of a record's head: each has its length, a name, an equals sign and its bytes."""
    found, place = {}, 0
    while place < len(head):
        (size,) = _LENGTH.unpack_from(head, place)
        name, _, value = head[place + 4 : place + 4 + size].partition(b"=")
        found[name] = value
        place += 4 + size
    return found
