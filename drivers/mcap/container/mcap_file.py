"""MCAP files, whose records the library mcap reads."""

import logging
import shlex
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import MCAP_MAGIC, open_regular
from nurbseg.common.limits import CHUNK_BYTES_MAX, CHUNK_RECORDS_MAX, RECORD_BYTES_MAX
from nurbseg.drivers.calibration.foreign import HEAD_BYTES, stand_in
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.messages import (
    MessageFile,
    Stored,
    Topic,
    decompressed,
    whole_message,
)

_log = logging.getLogger(__name__)

#: Head of a record: its kind and the length of its content.
_HEAD = struct.Struct("<BQ")
#: Bytes of a message index before its entries, and of one entry.
_INDEX_HEAD_BYTES, _INDEX_ENTRY_BYTES = 6, 16


class _Entry(NamedTuple):
    """Where a chunk, or a message outside chunks, begins, and the channels of its messages.

    The channels come with counts only where the file was walked through, as the index has none.
    """

    place: int
    counts: Counter[int]


class McapFile(MessageFile):
    """An MCAP file [1]_ opened for reading.

    Chunks are found by the index at its end or, if its writer was killed before it wrote one, by going from
    record to record. Raises RecordingFormatError if it is no such file.

    References
    ----------
    .. [1] MCAP file format specification, https://mcap.dev/spec
    """

    form = "MCAP recording"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._file = open_regular(path)
        # Every topic reads the same chunk in turn.
        self._messages_at = lru_cache(maxsize=2)(self._read_messages)
        with closed_on_error(self.close):
            head = self._file.read(HEAD_BYTES)
            if not head.startswith(MCAP_MAGIC):
                kind = stand_in(head) or "expected an MCAP file"
                raise RecordingFormatError(f"{path}: magic bytes: {kind}")
            # Nothing depends on the header, which may be damaged.
            with suppress(Exception):
                self.profile = SeekingReader(self._file).get_header().profile
            self._entries, counts = self._indexed() or self._walked()
        self.in_order = ros.RECORDING_RECORD in self.metadata
        for number, channel in self.channels.items():
            if counts[number]:
                schema = self.schemas.get(channel.schema_id)
                name, _, before = self.topics.get(channel.topic, (schema.name if schema else "", "", 0))
                self.topics[channel.topic] = Topic(name, channel.message_encoding, before + counts[number])
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
        self._messages_at.cache_clear()
        self._file.close()

    def every_message(self) -> Iterator[tuple[Channel, Message] | FrameFormatError]:
        """Yield all messages and their channels in the file's order; a damaged chunk is one error."""
        for entry in self._entries:
            try:
                yield from ((self.channels[each.channel_id], each) for each in self._messages_at(entry.place))
            except FrameFormatError as err:
                yield err

    def _of_topic(self, topic: str, after: tuple[int, int] | None) -> Iterator[Stored]:
        channels = {number for number, each in self.channels.items() if each.topic == topic}
        first, last = after or (0, -1)
        for number, entry in enumerate(self._entries[first:], first):
            # The channels of a damaged chunk without an index are unknown.
            if entry.counts and channels.isdisjoint(entry.counts):
                continue
            try:
                messages = self._messages_at(entry.place)
            except FrameFormatError as err:
                yield Stored((number, 0), 0, err)
                continue
            for k in range(last + 1 if number == first else 0, len(messages)):
                if messages[k].channel_id in channels:
                    yield Stored((number, k), messages[k].log_time, messages[k].data)

    def _indexed(self) -> tuple[list[_Entry], Counter[int]] | None:
        """Return the chunks and the messages of each channel by the index; None if there is none."""
        self._file.seek(0)
        try:
            reader = SeekingReader(self._file, record_size_limit=RECORD_BYTES_MAX)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None or not summary.chunk_indexes:
                return None
            if not all(each.message_index_offsets for each in summary.chunk_indexes) or not summary.channels:
                return None
            self.metadata = {each.name: each.metadata for each in reader.iter_metadata()}
        except Exception:  # The library raises errors of many kinds for a damaged file.
            return None
        self.schemas, self.channels = summary.schemas, summary.channels
        self.span_ns = summary.statistics.message_end_time - summary.statistics.message_start_time
        places = [(each.chunk_start_offset, each.message_index_offsets) for each in summary.chunk_indexes]
        entries = [_Entry(place, Counter(offsets.keys())) for place, offsets in sorted(places)]
        return entries, Counter(summary.statistics.channel_message_counts)

    def _walked(self) -> tuple[list[_Entry], Counter[int]]:
        """Return the same by going from record to record, as far as there are any."""
        entries: list[_Entry] = []
        self.whole = False
        size = self._file.seek(0, 2)
        place = len(MCAP_MAGIC)
        while place + _HEAD.size <= size:
            self._file.seek(place)
            opcode, length = _HEAD.unpack(self._file.read(_HEAD.size))
            start, place = place, place + _HEAD.size + length
            # No record has kind 0: zeros may follow what was written.
            if opcode in (0, Opcode.FOOTER) or place > size:
                self.whole = opcode == Opcode.FOOTER and place + len(MCAP_MAGIC) <= size
                break
            if opcode == Opcode.CHUNK:
                entries.append(_Entry(start, Counter()))
            elif opcode == Opcode.MESSAGE:
                entries.append(_Entry(start, Counter([int.from_bytes(self._file.read(2), "little")])))
            elif opcode == Opcode.MESSAGE_INDEX and entries:
                channel = int.from_bytes(self._file.read(2), "little")
                entries[-1].counts[channel] += (length - _INDEX_HEAD_BYTES) // _INDEX_ENTRY_BYTES
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                try:
                    self._register(self._record_at(start, RECORD_BYTES_MAX))
                except Exception as err:
                    name = f"{self.path}: {Opcode(opcode).name}"
                    raise RecordingFormatError(f"{name}: damaged ({quoted(str(err))})") from err
        if entries and not self.whole:
            entries[-1].counts.clear()  # its index may be cut off
        for entry in entries:
            if not entry.counts or not entry.counts.keys() <= self.channels.keys():
                try:
                    found = Counter(each.channel_id for each in self._messages_at(entry.place))
                except FrameFormatError as err:
                    self.damage = self.damage or str(err)
                    continue
                entry.counts.clear()
                entry.counts.update(found)
        return entries, sum((each.counts for each in entries), Counter())

    def _record_at(self, place: int, bytes_max: int) -> McapRecord:
        self._file.seek(place)
        reader = StreamReader(self._file, skip_magic=True, emit_chunks=True, record_size_limit=bytes_max)
        return next(reader.records)

    def _read_messages(self, place: int) -> list[Message]:
        """Return the messages of the chunk or message at a place, and register its channels."""
        name = f"{self.path}: the record at byte {place}"
        try:
            record = self._record_at(place, CHUNK_BYTES_MAX)
            records = _records_in(record) if isinstance(record, Chunk) else [record]
            messages = [each for each in records if isinstance(each, Message)]
            for each in records:
                self._register(each)
            for message in messages:
                message.data = whole_message(message.data)
        except OSError as err:
            raise RecordingFormatError(f"{name}: cannot be read ({err.strerror})") from err
        except Exception as err:  # The libraries raise errors of many kinds for damage.
            raise FrameFormatError(f"{name}: damaged ({quoted(str(err))})") from err
        return [each for each in messages if each.channel_id in self.channels]

    def _register(self, record: McapRecord) -> None:
        match record:
            case Schema():
                self.schemas[record.id] = record
            case Channel():
                self.channels[record.id] = record
            case Metadata():
                self.metadata[record.name] = record.metadata


def _records_in(chunk: Chunk) -> list[McapRecord]:
    """Return the records of a chunk by the library's `breakup_chunk`, which trusts the sizes that it states.

    Raises ValueError, or what the libraries raise, if it is damaged or too large.
    """
    size = chunk.uncompressed_size
    if size > CHUNK_BYTES_MAX:
        raise ValueError(f"uncompressed_size: {size} bytes; expected {CHUNK_BYTES_MAX} at most")
    content = decompressed(chunk.data, chunk.compression, size)
    if len(content) != size:
        there = "more" if len(content) > size else f"{len(content)} bytes"
        raise ValueError(f"uncompressed_size: {size} bytes are declared, {there} are there")
    end = number = 0
    while end + _HEAD.size <= size:
        kind, length = _HEAD.unpack_from(content, end)
        end, number = end + _HEAD.size + length, number + 1
        if kind == 0 or end > size or number > CHUNK_RECORDS_MAX:
            raise ValueError(f"record {number}: of the kind {kind}, {length} bytes")
    return breakup_chunk(replace(chunk, compression="", data=content), validate_crc=True)
