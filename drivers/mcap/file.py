"""Reads an MCAP file as far as it goes, complete or cut off.

The file is read record by record and needs no index at its end, since a recording whose writer was
killed has none. Of a chunk that is cut off, the part that is there is decompressed.

References
----------
.. [1] MCAP file format specification, https://mcap.dev/spec
"""

import logging
import math
import shlex
import struct
import zlib
from collections.abc import Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Message, Metadata, Schema, Statistics

from nurbseg.drivers.closing import Closing, closed_on_error
from nurbseg.drivers.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.drivers.files import MCAP_MAGIC, open_regular
from nurbseg.drivers.limits import (
    CATALOG_BYTES_MAX,
    CHUNK_BYTES_MAX,
    CHUNK_RECORDS_MAX,
    RECORD_BYTES_MAX,
)

_log = logging.getLogger(__name__)

_RECORD_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
#: Bytes of a message before its content.
_MESSAGE_HEAD_BYTES = 22
#: The records that say what a file holds.
_CATALOG: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.STATISTICS: Statistics,
}


class McapFile(Closing):
    """An MCAP file opened for reading; raises RecordingFormatError if it is none.

    `profile` is what its messages follow, such as "ros2", and may be empty; `metadata` are its records of
    that kind. `schemas` and `channels` are those known so far: all of them once `messages` has come to its
    end, and from the beginning if the file has an index, which also has the `message_counts` of the channels.
    `whole` is whether the file reaches its end. `entry` is the number of the chunk, or message outside of
    one, that the last message came from.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.profile = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.message_counts: dict[int, int] = {}
        self.whole = False
        self.entry = 0
        #: Places and lengths of the chunks and of messages outside of chunks.
        self._entries: list[tuple[int, int, int]] = []
        self._catalog_bytes = 0
        self._sizes: dict[tuple[int, int | str], int] = {}
        self._file = open_regular(path)
        with closed_on_error(self._file.close):
            self._scan()
        if not self.whole:
            _log.warning(
                "%s: the recording is cut off after %d bytes; it is replayed up to its last complete "
                "frame (nurbseg-record repair %s writes a complete copy)",
                path,
                path.stat().st_size,
                shlex.quote(str(path)),
            )

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()

    def messages(
        self, most_bytes: int | None = None, *, first: int = 0
    ) -> Iterator[tuple[Channel, Message] | FrameFormatError]:
        """Yield the messages and their channels in the file's order; an error in place of a damaged chunk.

        Ends after `most_bytes` of messages, decompressed. `first` is the entry to begin with, which `entry`
        was before.
        """
        left = math.inf if most_bytes is None else most_bytes
        for entry, (opcode, place, length) in enumerate(self._entries[first:], start=first):
            self.entry = entry
            if left < 0:
                return
            name = f"{self.path}: the {Opcode(opcode).name.lower()} at byte {place}"
            if length > CHUNK_BYTES_MAX:
                yield FrameFormatError(f"{name}: {length} bytes; expected {CHUNK_BYTES_MAX} at most")
                continue
            try:
                self._file.seek(place)
                content = self._file.read(length)
            except OSError as err:
                raise RecordingFormatError(f"{name}: cannot be read ({err.strerror})") from err
            left -= length
            try:
                records: Iterable[tuple[int, bytes]] = [(opcode, content)]
                if opcode == Opcode.CHUNK:
                    content = _chunk_content(content, name)
                    left -= len(content)
                    records = _records(content, name)
                for kind, record in records:
                    if kind != Opcode.MESSAGE:
                        self._register(kind, record)
                    elif len(record) >= _MESSAGE_HEAD_BYTES:
                        message = Message.read(ReadDataStream(BytesIO(record)), len(record))
                        if message.channel_id in self.channels:
                            yield self.channels[message.channel_id], message
            except FrameFormatError as err:
                yield err

    def _scan(self) -> None:
        size = self._file.seek(0, 2)
        self._file.seek(0)
        if self._file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise RecordingFormatError(f"{self.path}: magic bytes: expected an MCAP file")
        place = len(MCAP_MAGIC)
        while place + _RECORD_HEAD.size <= size:
            self._file.seek(place)
            opcode, length = _RECORD_HEAD.unpack(self._file.read(_RECORD_HEAD.size))
            place += _RECORD_HEAD.size
            if opcode == 0:
                # There is no such record: the file was made longer than what was written.
                return
            if opcode == Opcode.FOOTER:
                self.whole = place + length + len(MCAP_MAGIC) <= size
                return
            present = min(length, size - place)
            if opcode == Opcode.CHUNK or (opcode == Opcode.MESSAGE and present == length):
                self._entries.append((opcode, place, present))
            elif present == length and opcode in _CATALOG:
                if length > RECORD_BYTES_MAX:
                    name = f"{self.path}: {Opcode(opcode).name}"
                    raise RecordingFormatError(f"{name}: {length} bytes; expected {RECORD_BYTES_MAX} at most")
                self._register(opcode, self._file.read(length))
            place += length

    def _register(self, opcode: int, content: bytes) -> None:
        if opcode not in _CATALOG:
            return
        try:
            record = _CATALOG[opcode].read(ReadDataStream(BytesIO(content)))
        except (McapError, struct.error, UnicodeDecodeError) as err:
            raise RecordingFormatError(f"{self.path}: {Opcode(opcode).name}: damaged ({err})") from err
        # They are kept, and each chunk may hold others.
        key = opcode, getattr(record, "id", getattr(record, "name", ""))
        self._catalog_bytes += len(content) - self._sizes.get(key, 0)
        self._sizes[key] = len(content)
        if self._catalog_bytes > CATALOG_BYTES_MAX:
            what = f"{Opcode(opcode).name}: over {CATALOG_BYTES_MAX} bytes of schemas, channels and metadata"
            raise RecordingFormatError(f"{self.path}: {what}")
        match record:
            case Header():
                self.profile = record.profile
            case Schema():
                self.schemas[record.id] = record
            case Channel():
                self.channels[record.id] = record
            case Metadata():
                self.metadata[record.name] = record.metadata
            case Statistics():
                self.message_counts = dict(record.channel_message_counts)


def _records(content: bytes, name: str) -> Iterator[tuple[int, bytes]]:
    """Yield the whole records in a chunk's content."""
    place = 0
    number = 0
    while place + _RECORD_HEAD.size <= len(content):
        opcode, length = _RECORD_HEAD.unpack_from(content, place)
        place += _RECORD_HEAD.size
        if place + length > len(content):
            return
        number += 1
        if number > CHUNK_RECORDS_MAX or opcode == 0:
            raise FrameFormatError(
                f"{name}: records: expected {CHUNK_RECORDS_MAX} at most and none of the kind 0, "
                f"got the kind {opcode} in place {number}"
            )
        yield opcode, content[place : place + length]
        place += length


def _chunk_content(content: bytes, name: str) -> bytes:
    """Return the uncompressed records of a chunk, or of as much of it as there is."""
    if len(content) < _CHUNK_HEAD.size:
        return b""
    _, _, size, crc, word = _CHUNK_HEAD.unpack_from(content)
    place = _CHUNK_HEAD.size + word
    if len(content) < place + 8:
        return b""
    compression = content[_CHUNK_HEAD.size : place].decode(errors="replace")
    if size > CHUNK_BYTES_MAX:
        raise FrameFormatError(f"{name}: uncompressed_size: {size} bytes; expected {CHUNK_BYTES_MAX} at most")
    length = int.from_bytes(content[place : place + 8], "little")
    compressed = content[place + 8 : place + 8 + length]
    cut_off = len(compressed) < length
    try:
        records = _decompressed(compressed, compression, size, name)
    except (zstandard.ZstdError, RuntimeError, EOFError) as err:
        if cut_off:
            return b""
        raise FrameFormatError(f"{name}: cannot be decompressed ({err})") from err
    if len(records) > size or (not cut_off and len(records) < size):
        there = "more" if len(records) > size else f"{len(records)} bytes"
        raise FrameFormatError(f"{name}: uncompressed_size: {size} bytes are declared, {there} are there")
    if not cut_off and crc and zlib.crc32(records) != crc:
        raise FrameFormatError(f"{name}: damaged (checksum)")
    return records


def _decompressed(content: bytes, compression: str, size: int, name: str) -> bytes:
    """Return the decompressed content, at most one byte more than `size`."""
    if compression == "":
        return content
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=size + 1))
    if compression != "zstd":
        raise FrameFormatError(f"{name}: compression: expected zstd, lz4 or none, got {quoted(compression)}")
    return zstandard.ZstdDecompressor().stream_reader(content).read(size + 1)
