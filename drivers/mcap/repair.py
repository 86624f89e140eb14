"""Writes what can be read of an MCAP file as a whole one, with an index."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from mcap.records import Channel, Schema
from mcap.writer import Writer

from nurbseg.drivers.errors import FrameFormatError
from nurbseg.drivers.mcap.file import McapFile


def rewrite(path: Path, output: BinaryIO) -> int:
    """Copy the messages of a recording, as they are, and its metadata; return how many chunks were damaged.

    It may be whole or not, whoever wrote it. Attachments do not come with it. Raises RecordingFormatError if
    it is not an MCAP file, and OSError if the new one cannot be written.
    """
    damaged = 0
    source = McapFile(path)
    try:
        writer = Writer(output)
        writer.start(profile=source.profile)
        for name, values in source.metadata.items():
            writer.add_metadata(name, values)
        channels: dict[int, int] = {}
        for item in source.messages():
            if isinstance(item, FrameFormatError):
                damaged += 1
                continue
            channel = item.channel
            if channel.id not in channels:
                channels[channel.id] = _registered(channel, source.schemas, writer)
            writer.add_message(
                channels[channel.id], item.log_time_ns, item.content, item.publish_time_ns, item.sequence
            )
        writer.finish()  # type: ignore[no-untyped-call]
    finally:
        source.close()
    return damaged


def _registered(channel: Channel, schemas: Mapping[int, Schema], writer: Writer) -> int:
    """Give a channel, with its schema, a number in the new file."""
    schema = schemas.get(channel.schema_id)
    number = 0 if schema is None else writer.register_schema(schema.name, schema.encoding, schema.data)
    return writer.register_channel(channel.topic, channel.message_encoding, number, channel.metadata)
