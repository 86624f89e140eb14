"""Bags of ROS 2: SQLite databases as its older recorders lay them out, and what rosbags writes."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

#: Of older versions, without definitions.
TABLES = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
    "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)",
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
    "data BLOB NOT NULL)",
    "CREATE INDEX timestamp_idx ON messages (timestamp ASC)",
)


def to_database(mcap: Path, path: Path, *, packed: Callable[[bytes], bytes] = bytes) -> Path:
    """Write the messages of an MCAP file to a database."""
    with mcap.open("rb") as stream, sqlite3.connect(path) as base:
        for each in TABLES:
            base.execute(each)
        numbers: dict[str, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if channel.topic not in numbers:
                numbers[channel.topic] = len(numbers) + 1
                topic = (numbers[channel.topic], channel.topic, schema.name)
                base.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", topic)
            base.execute(
                "INSERT INTO messages VALUES (NULL, ?, ?, ?)",
                (numbers[channel.topic], message.log_time, packed(message.data)),
            )
    base.close()
    return path


def to_bag(path: Path, folder: Path, *, mcap: bool = False, packed: bool = False) -> Path:
    """Write the messages of an MCAP file to a bag: a database or MCAP file, each message packed or not."""
    from robot_bag import TYPES
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3)
    if packed:
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with path.open("rb") as stream, writer:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if channel.topic not in connections:
                connections[channel.topic] = writer.add_connection(
                    channel.topic, schema.name, typestore=TYPES
                )
            writer.write(connections[channel.topic], message.log_time, message.data)
    return folder
