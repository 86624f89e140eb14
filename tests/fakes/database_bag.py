"""Bags of ROS 2 in SQLite databases, as its recorder lays them out."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader

#: Of older versions, without definitions.
TABLES = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, "
    "serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL)",
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, "
    "data BLOB NOT NULL)",
    "CREATE INDEX timestamp_idx ON messages (timestamp ASC)",
)


def to_database(
    mcap: Path, path: Path, *, packed: Callable[[bytes], bytes] = bytes, definitions: bool = False
) -> Path:
    """Write the messages of an MCAP file to a database."""
    with mcap.open("rb") as stream, sqlite3.connect(path) as base:
        source = make_reader(stream)
        for each in TABLES:
            base.execute(each)
        if definitions:
            base.execute(
                "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, "
                "encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL, "
                "type_description_hash TEXT NOT NULL)"
            )
            summary = source.get_summary()
            assert summary is not None
            for schema in summary.schemas.values():
                base.execute(
                    "INSERT INTO message_definitions VALUES (NULL, ?, ?, ?, '')",
                    (schema.name, schema.encoding, schema.data.decode()),
                )
        numbers: dict[str, int] = {}
        for kind, channel, message in source.iter_messages():
            assert kind is not None
            if channel.topic not in numbers:
                numbers[channel.topic] = len(numbers) + 1
                base.execute(
                    "INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')",
                    (numbers[channel.topic], channel.topic, kind.name),
                )
            base.execute(
                "INSERT INTO messages VALUES (NULL, ?, ?, ?)",
                (numbers[channel.topic], message.log_time, packed(message.data)),
            )
    base.close()
    return path
