"""Reads an MCAP file as far as it goes, whole or cut off.

The file is walked record by record and needs no index at its end, since a recording whose writer was
killed has none. Of a chunk that is cut off, the part that is there is decompressed.

References
----------
.. [1] MCAP file format specification, https://mcap.dev/spec
"""

from __future__ import annotations

import logging
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema, Statistics

from nurbseg.drivers.errors import FrameFormatError, RecordingFormatError

_log = logging.getLogger(__name__)

MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
#: A larger chunk is taken for damage; writers make them of some megabytes.
_CHUNK_BYTES_MAX = 1 << 30


@dataclass(frozen=True, slots=True)
class McapMessage:
    """One message: its channel and its undecoded content."""

    channel: Channel
    log_time_ns: int
    content: bytes


class McapFile:
    """An MCAP file opened for reading.

    Parameters
    ----------
    path : Path
        The file.

    Attributes
    ----------
    metadata : dict of str to dict
        The file's metadata records.
    schemas, channels : dict
        Those known so far; all of them once `messages` has come to its end, and from the beginning if
        the file has an index.
    message_counts : dict of int to int
        Messages of each channel, if the file has an index.
    whole : bool
        Whether the file reaches its end.

    Raises
    ------
    RecordingFormatError
        If it is not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.message_counts: dict[int, int] = {}
        self.whole = False
        #: Places and lengths of the chunks and of messages outside of chunks.
        self._entries: list[tuple[int, int, int]] = []
        try:
            self._file = path.open("rb")
        except OSError as err:
            raise RecordingFormatError(f"{path}: cannot be read ({err.strerror})") from err
        try:
            self._walk()
        except BaseException:
            self._file.close()
            raise
        if not self.whole:
            _log.warning(
                "%s: the recording is cut off after %d bytes; it is replayed up to its last whole frame",
                path,
                path.stat().st_size,
            )

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._file.close()

    def messages(self) -> Iterator[McapMessage | FrameFormatError]:
        """Yield the messages in the file's order; an error in place of a chunk that is damaged."""
        for opcode, place, length in self._entries:
            self._file.seek(place)
            content = self._file.read(length)
            if opcode == Opcode.MESSAGE:
                message = self._message(content)
                if message is not None:
                    yield message
                continue
            try:
                records = _chunk_records(content, f"{self.path}: the chunk at byte {place}")
            except FrameFormatError as err:
                yield err
                continue
            for kind, record in _records(records):
                if kind == Opcode.MESSAGE:
                    message = self._message(record)
                    if message is not None:
                        yield message
                else:
                    self._learn(kind, record)

    def _walk(self) -> None:
        size = self._file.seek(0, 2)
        self._file.seek(0)
        if self._file.read(len(MAGIC)) != MAGIC:
            raise RecordingFormatError(f"{self.path}: magic bytes: expected an MCAP file")
        place = len(MAGIC)
        while place + _RECORD_HEAD.size <= size:
            self._file.seek(place)
            opcode, length = _RECORD_HEAD.unpack(self._file.read(_RECORD_HEAD.size))
            place += _RECORD_HEAD.size
            if opcode == Opcode.FOOTER:
                self.whole = place + length + len(MAGIC) <= size
                return
            present = min(length, size - place)
            if opcode == Opcode.CHUNK or (opcode == Opcode.MESSAGE and present == length):
                self._entries.append((opcode, place, present))
            elif present == length:
                self._learn(opcode, self._file.read(length))
            place += length

    def _learn(self, opcode: int, content: bytes) -> None:
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(content))
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(content))
                self.channels[channel.id] = channel
            elif opcode == Opcode.METADATA:
                record = Metadata.read(_stream(content))
                self.metadata[record.name] = record.metadata
            elif opcode == Opcode.STATISTICS:
                self.message_counts = dict(Statistics.read(_stream(content)).channel_message_counts)
        except (McapError, struct.error, UnicodeDecodeError) as err:
            raise RecordingFormatError(f"{self.path}: {Opcode(opcode).name}: damaged ({err})") from err

    def _message(self, content: bytes) -> McapMessage | None:
        if len(content) < _MESSAGE_HEAD.size:
            return None
        channel_id, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(content)
        channel = self.channels.get(channel_id)
        if channel is None:
            return None
        return McapMessage(channel, log_time_ns, content[_MESSAGE_HEAD.size :])


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))


def _records(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the whole records in a chunk's content."""
    place = 0
    while place + _RECORD_HEAD.size <= len(content):
        opcode, length = _RECORD_HEAD.unpack_from(content, place)
        place += _RECORD_HEAD.size
        if place + length > len(content):
            return
        yield opcode, content[place : place + length]
        place += length


def _chunk_records(content: bytes, name: str) -> bytes:
    """Return the uncompressed records of a chunk, or of as much of it as there is."""
    if len(content) < _CHUNK_HEAD.size:
        return b""
    _, _, uncompressed, crc, word = _CHUNK_HEAD.unpack_from(content)
    place = _CHUNK_HEAD.size + word
    if len(content) < place + 8:
        return b""
    compression = content[_CHUNK_HEAD.size : place].decode(errors="replace")
    if uncompressed > _CHUNK_BYTES_MAX:
        raise FrameFormatError(f"{name}: uncompressed_size: {uncompressed} bytes are taken for damage")
    length = int.from_bytes(content[place : place + 8], "little")
    compressed = content[place + 8 : place + 8 + length]
    cut_off = len(compressed) < length
    expanders: dict[str, Callable[[], Any] | None] = {
        "zstd": lambda: zstandard.ZstdDecompressor().decompressobj(),
        "lz4": lz4.frame.LZ4FrameDecompressor,
        "": None,
    }
    if compression not in expanders:
        raise FrameFormatError(f"{name}: compression: expected zstd, lz4 or none, got {compression!r}")
    expander = expanders[compression]
    try:
        if expander is None:
            records = compressed
        elif compression == "zstd" and not cut_off:
            records = zstandard.decompress(compressed, uncompressed)
        else:
            records = expander().decompress(compressed)
    except (zstandard.ZstdError, RuntimeError, EOFError) as err:
        if cut_off:
            return b""
        raise FrameFormatError(f"{name}: cannot be decompressed ({err})") from err
    if not cut_off and crc and zlib.crc32(records) != crc:
        raise FrameFormatError(f"{name}: damaged (checksum)")
    return bytes(records)
