"""MCAP files, whose records are read by the library mcap."""

import logging
import shlex
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import MCAP_MAGIC, open_regular
from nurbseg.common.limits import CATALOG_BYTES_MAX, CHUNK_BYTES_MAX, RECORD_BYTES_MAX
from nurbseg.drivers.calibration.foreign import HEAD_BYTES, stand_in
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.chunk import RECORD_HEAD, chunk_records, whole_message
from nurbseg.drivers.mcap.container.messages import MessageFile, Stored, Topic

_log = logging.getLogger(__name__)

#: The records that say what a file holds.
_CATALOG: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
}
#: Of a message index: bytes before its entries, and of each.
_INDEX_HEAD_BYTES, _INDEX_ENTRY_BYTES = 6, 16
#: Bytes of a message before its content: the channel, a number, and two times.
_MESSAGE_HEAD = struct.Struct("<HIQQ")


class _Entry(NamedTuple):
    """A chunk, or a message outside of chunks: where it begins, and how many messages each channel has.

    The index at the end of a file gives no numbers: they are 1.
    """

    place: int
    counts: Counter[int]


class McapFile(MessageFile):
    """An MCAP file [1]_ opened for reading.

    Chunks are found by the index at its end or, where the writer was killed before it wrote one, by going
    from record to record. Raises RecordingFormatError if it is no such file.

    References
    ----------
    .. [1] MCAP file format specification, https://mcap.dev/spec
    """

    form = "MCAP recording"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._kept = 0
        self._file = open_regular(path)
        # A chunk is taken by each topic in turn.
        self._records = lru_cache(maxsize=2)(self._read_records)
        with closed_on_error(self.close):
            head = self._file.read(HEAD_BYTES)
            if not head.startswith(MCAP_MAGIC):
                kind = stand_in(head) or "expected an MCAP file"
                raise RecordingFormatError(f"{path}: magic bytes: {kind}")
            # A header that is damaged says nothing, and nothing depends on it.
            with suppress(Exception):
                self.profile = SeekingReader(self._file).get_header().profile
            self._entries, counts = self._indexed() or self._walked()
        self.in_order = ros.RECORDING_RECORD in self.metadata
        for number, channel in self.channels.items():
            if counts[number]:
                schema = self.schemas.get(channel.schema_id, Schema(id=0, data=b"", encoding="", name=""))
                schema, _, before = self.topics.get(channel.topic, (schema, "", 0))
                self.topics[channel.topic] = Topic(schema, channel.message_encoding, before + counts[number])
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
        self._records.cache_clear()
        self._file.close()

    def every_message(self) -> Iterator[tuple[Channel, Message] | FrameFormatError]:
        """Yield all messages and their channels in the file's order; a damaged chunk is one error."""
        for entry in self._entries:
            try:
                yield from ((self.channels[each.channel_id], each) for each in self._records(entry.place))
            except FrameFormatError as err:
                yield err

    def _of_topic(self, topic: str, after: tuple[int, int] | None) -> Iterator[Stored]:
        channels = {number for number, each in self.channels.items() if each.topic == topic}
        first, last = after or (0, -1)
        for number in range(first, len(self._entries)):
            entry = self._entries[number]
            # Nobody knows whose messages are in a chunk that is damaged and has no index.
            if entry.counts and channels.isdisjoint(entry.counts):
                continue
            try:
                records = self._records(entry.place)
            except FrameFormatError as err:
                yield Stored((number, 0), 0, err)
                continue
            for k in range(last + 1 if number == first else 0, len(records)):
                if records[k].channel_id in channels:
                    yield Stored((number, k), records[k].log_time, records[k].data)

    def _indexed(self) -> tuple[list[_Entry], Counter[int]] | None:
        """Return the chunks, and the messages of each channel, by the index; None where there is none."""
        self._file.seek(0)
        try:
            reader = SeekingReader(self._file, record_size_limit=RECORD_BYTES_MAX)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None or not summary.chunk_indexes:
                return None
            if not all(each.message_index_offsets for each in summary.chunk_indexes) or not summary.channels:
                return None
            if sum(each.length for each in summary.metadata_indexes) > CATALOG_BYTES_MAX:
                return None
            self.metadata = {each.name: each.metadata for each in reader.iter_metadata()}
        except Exception:  # The library raises whatever a damaged file leads it to.
            return None
        self.schemas, self.channels = summary.schemas, summary.channels
        self.span_ns = summary.statistics.message_end_time - summary.statistics.message_start_time
        places = [(each.chunk_start_offset, each.message_index_offsets) for each in summary.chunk_indexes]
        entries = [_Entry(place, Counter(dict.fromkeys(offsets, 1))) for place, offsets in sorted(places)]
        return entries, Counter(summary.statistics.channel_message_counts)

    def _walked(self) -> tuple[list[_Entry], Counter[int]]:
        """Return the same by going from record to record, as far as there are any."""
        entries: list[_Entry] = []
        self.whole = False
        size = self._file.seek(0, 2)
        place = len(MCAP_MAGIC)
        while place + RECORD_HEAD.size <= size:
            self._file.seek(place)
            opcode, length = RECORD_HEAD.unpack(self._file.read(RECORD_HEAD.size))
            start, place = place, place + RECORD_HEAD.size + length
            # There is no kind 0: a file may be longer than what was written.
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
            elif opcode in _CATALOG:
                if length > RECORD_BYTES_MAX:
                    name = f"{self.path}: {Opcode(opcode).name}"
                    raise RecordingFormatError(f"{name}: {length} bytes; expected {RECORD_BYTES_MAX} at most")
                self._register(opcode, self._file.read(length))
        if entries and not self.whole:
            entries[-1].counts.clear()  # its index may be cut off
        for entry in entries:
            if not entry.counts or not entry.counts.keys() <= self.channels.keys():
                try:
                    found = Counter(each.channel_id for each in self._records(entry.place))
                except FrameFormatError as err:
                    self.damage = self.damage or str(err)
                    continue
                entry.counts.clear()
                entry.counts.update(found)
        return entries, sum((each.counts for each in entries), Counter())

    def _read_records(self, place: int) -> list[Message]:
        """Return the messages of the chunk or message at a place, and learn of its channels."""
        name = f"{self.path}: the record at byte {place}"
        try:
            self._file.seek(place)
            reader = StreamReader(
                self._file, skip_magic=True, emit_chunks=True, record_size_limit=CHUNK_BYTES_MAX
            )
            record = next(reader.records)
            messages = [record] if isinstance(record, Message) else []
            for kind, content in chunk_records(record) if isinstance(record, Chunk) else ():
                if kind == Opcode.MESSAGE:
                    messages.append(_message(content))
                elif kind in _CATALOG:
                    self._register(kind, content)
            for message in messages:
                message.data = whole_message(message.data)
        except OSError as err:
            raise RecordingFormatError(f"{name}: cannot be read ({err.strerror})") from err
        except RecordingFormatError:
            raise
        except Exception as err:  # The libraries raise whatever damage leads them to.
            raise FrameFormatError(f"{name}: damaged ({quoted(str(err))})") from err
        return [each for each in messages if each.channel_id in self.channels]

    def _register(self, kind: int, content: bytes) -> None:
        name = f"{self.path}: {Opcode(kind).name}"
        try:
            record = _CATALOG[kind](ReadDataStream(BytesIO(content)))
        except (McapError, struct.error, ValueError) as err:
            raise RecordingFormatError(f"{name}: damaged ({err})") from err
        match record:
            case Schema():
                is_new, self.schemas[record.id] = record.id not in self.schemas, record
            case Channel():
                is_new, self.channels[record.id] = record.id not in self.channels, record
            case Metadata():
                is_new, self.metadata[record.name] = record.name not in self.metadata, record.metadata
        # They are kept, and each chunk may hold others.
        self._kept += len(content) * is_new
        if self._kept > CATALOG_BYTES_MAX:
            what = "of schemas, channels and metadata"
            raise RecordingFormatError(f"{name}: over {CATALOG_BYTES_MAX} bytes {what}")


def _message(content: bytes) -> Message:
    """Return a message record, which the library would read field by field."""
    channel, sequence, log_ns, publish_ns = _MESSAGE_HEAD.unpack_from(content)
    return Message(channel, log_ns, content[_MESSAGE_HEAD.size :], publish_ns, sequence)
