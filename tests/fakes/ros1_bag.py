"""Bags of ROS 1, written by rosbags from the messages of an MCAP file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcap.reader import make_reader


def to_ros1(
    mcap: Path, path: Path, compression: str | None = None, renamed: dict[str, str] | None = None
) -> Path:
    """Write them as messages of ROS 1; `renamed` are other names of topics."""
    from rosbags.convert.converter import migrate_bytes
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    ros2, ros1 = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
    for store in (ros1, ros2):
        transforms = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
    writer = Writer(path)
    if compression is not None:
        writer.set_compression(getattr(Writer.CompressionFormat, compression))
    connections: dict[str, Any] = {}
    cache: dict[Any, Any] = {}
    with mcap.open("rb") as stream, writer:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            kind = schema.name
            topic = (renamed or {}).get(channel.topic, channel.topic)
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ros1)
            raw = migrate_bytes(ros2, ros1, kind, kind, cache, message.data, src_is2=True, dst_is2=False)
            writer.write(connections[topic], message.log_time, raw)
    return path
