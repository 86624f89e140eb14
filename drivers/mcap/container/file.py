"""Reads an MCAP file as far as it goes, complete or cut off.

The file is gone through record by record and needs no summary at its end, since a recording whose writer
was killed has none. Where its messages are is known from the index that follows each chunk; a chunk without
one is decompressed to find out. Of a chunk that is cut off, the part that is there is decompressed.

References
----------
.. [1] MCAP file format specification, https://mcap.dev/spec
"""

import logging
import shlex
import struct
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Message, Metadata, Schema

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import FrameFormatError, RecordingFormatError
from nurbseg.common.files import MCAP_MAGIC, open_regular
from nurbseg.common.limits import (
    CATALOG_BYTES_MAX,
    CHUNK_BYTES_MAX,
    CHUNK_RECORDS_MAX,
    RECORD_BYTES_MAX,
    SCAN_BYTES_MAX,
)
from nurbseg.drivers.calibration.foreign import HEAD_BYTES, stand_in
from nurbseg.drivers.mcap.container.bag import MessageFile, Run
from nurbseg.drivers.mcap.container.chunk import RECORD_HEAD, chunk_content, chunk_records, whole_message

_log = logging.getLogger(__name__)

#: Bytes of a message before its content: the channel, a number, and two times.
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_INDEX_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])
_INDEX_HEAD_BYTES = 6
_TIME_MAX = np.iinfo(np.int64).max
#: Place of a message that stands for a whole chunk, whose messages cannot be told apart.
DAMAGED = -1
#: The records that say what a file holds.
_CATALOG: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
}


class McapFile(MessageFile):
    """An MCAP file opened for reading; raises RecordingFormatError if it is none.

    An entry is a chunk, or a message outside of one.
    """

    form = "MCAP recording"

    def __init__(self, path: Path) -> None:
        super().__init__(path, profile="")
        self.whole = False
        #: Opcodes, places and lengths of the entries.
        self._entries: list[tuple[int, int, int]] = []
        #: By channel, in the file's order: the place and length of the index of a chunk's messages, or ...
        self._indexes: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
        #: ... the messages themselves, found by going through a chunk that has none.
        self._found: dict[int, list[Run]] = defaultdict(list)
        self._held: dict[int, bytes] = {}
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
        self._held.clear()
        self._file.close()

    def messages(self) -> Iterator[tuple[Channel, Message] | FrameFormatError]:
        """Yield the messages and their channels in the file's order; an error in place of a damaged chunk."""
        for entry in range(len(self._entries)):
            try:
                content = self._content(entry)
                for kind, start, end in chunk_records(content, self._name(entry)):
                    message = self._message(content, start, end) if kind == Opcode.MESSAGE else None
                    if message is not None and message.channel_id in self.channels:
                        yield self.channels[message.channel_id], message
            except FrameFormatError as err:
                yield err

    def find_messages(self) -> None:
        """Go through the chunks that no index describes, and learn of all channels that have messages.

        Raises RecordingFormatError if these are too many; `damaged` are those that cannot be gone through.
        """
        indexed = {entry for places in self._indexes.values() for entry, _, _ in places}
        if not self.whole and self._entries:
            # Its index may be cut off.
            last = len(self._entries) - 1
            indexed.discard(last)
            for places in self._indexes.values():
                places[:] = [place for place in places if place[0] != last]
        left = SCAN_BYTES_MAX
        for entry, (opcode, _, _) in enumerate(self._entries):
            if opcode != Opcode.CHUNK or entry in indexed:
                continue
            with suppress(FrameFormatError):
                left -= len(self._content(entry))
                self._go_through(entry)
            if left < 0:
                raise RecordingFormatError(
                    f"{self.path}: over {SCAN_BYTES_MAX} bytes of chunks have no index: "
                    f"nurbseg-record repair {shlex.quote(str(self.path))} writes a copy that has one"
                )
        for channel, places in self._indexes.items():
            for entry, _, _ in places:
                if channel in self.channels:
                    break
                with suppress(FrameFormatError):
                    self._content(entry)

    def runs(self, channel: int) -> Iterator[Run]:
        """Yield the messages of a channel, entry by entry."""
        found = self._found.get(channel, [])
        place = 0
        for entry, start, length in self._indexes.get(channel, []):
            while place < len(found) and found[place].entry < entry:
                yield found[place]
                place += 1
            self._file.seek(start)
            index = np.frombuffer(self._file.read(length - length % _INDEX_ENTRY.itemsize), _INDEX_ENTRY)
            index = np.sort(index, order="offset")
            times_ns = np.minimum(index["time"], _TIME_MAX).astype(np.int64)
            yield Run(entry, times_ns, np.minimum(index["offset"], _TIME_MAX).astype(np.int64))
        yield from found[place:]

    def message(self, entry: int, offset: int) -> Message:
        """Return a message; raises FrameFormatError if its chunk, or the chunk's index, is damaged."""
        content = self._content(entry)
        end = 0
        if 0 <= offset <= len(content) - RECORD_HEAD.size:
            kind, length = RECORD_HEAD.unpack_from(content, offset)
            end = offset + RECORD_HEAD.size + length if kind == Opcode.MESSAGE else 0
        message = self._message(content, offset + RECORD_HEAD.size, end) if end <= len(content) else None
        if message is None:
            raise FrameFormatError(f"{self._name(entry)}: its index is damaged: no message at byte {offset}")
        message.data = whole_message(message.data, self._name(entry))
        return message

    def _name(self, entry: int) -> str:
        opcode, place, _ = self._entries[entry]
        return f"{self.path}: the {Opcode(opcode).name.lower()} at byte {place}"

    def _message(self, content: bytes, start: int, end: int) -> Message | None:
        if end - start < _MESSAGE_HEAD.size:
            return None
        channel, number, log_time, publish_time = _MESSAGE_HEAD.unpack_from(content, start)
        return Message(
            channel_id=channel,
            sequence=number,
            log_time=log_time,
            publish_time=publish_time,
            data=content[start + _MESSAGE_HEAD.size : end],
        )

    def _content(self, entry: int) -> bytes:
        """Return the decompressed records of an entry, some of which are held; learns of its channels."""
        if entry in self.damaged:
            raise FrameFormatError(self.damaged[entry])
        if entry in self._held:
            self._held[entry] = content = self._held.pop(entry)
            return content
        opcode, place, length = self._entries[entry]
        name = self._name(entry)
        try:
            if length > CHUNK_BYTES_MAX:
                raise FrameFormatError(f"{name}: {length} bytes; expected {CHUNK_BYTES_MAX} at most")
            is_chunk = opcode == Opcode.CHUNK
            head = 0 if is_chunk else RECORD_HEAD.size
            try:
                self._file.seek(place - head)
                content = self._file.read(head + length)
            except OSError as err:
                raise RecordingFormatError(f"{name}: cannot be read ({err.strerror})") from err
            if is_chunk:
                content = chunk_content(content, name)
                for kind, start, end in chunk_records(content, name):
                    if kind != Opcode.MESSAGE:
                        self._register(kind, content[start:end])
        except FrameFormatError as err:
            # The error itself would keep the content.
            self.damaged[entry] = str(err)
            raise
        self._held[entry] = content
        while len(self._held) > 1 and sum(map(len, self._held.values())) > CHUNK_BYTES_MAX:
            self._held.pop(next(iter(self._held)))
        return content

    def _go_through(self, entry: int) -> None:
        """Note the messages of a chunk that has no index."""
        content = self._content(entry)
        found: dict[int, list[tuple[int, int]]] = defaultdict(list)
        for kind, start, end in chunk_records(content, self._name(entry)):
            if kind == Opcode.MESSAGE and end - start >= _MESSAGE_HEAD.size:
                channel, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content, start)
                found[channel].append((min(log_time, int(_TIME_MAX)), start - RECORD_HEAD.size))
        for channel, each in found.items():
            times_ns, offsets = np.array(each, dtype=np.int64).T
            self._found[channel].append(Run(entry, times_ns, offsets))

    def _scan(self) -> None:
        size = self._file.seek(0, 2)
        self._file.seek(0)
        head = self._file.read(HEAD_BYTES)
        if not head.startswith(MCAP_MAGIC):
            kind = stand_in(head) or "expected an MCAP file"
            raise RecordingFormatError(f"{self.path}: magic bytes: {kind}")
        place = len(MCAP_MAGIC)
        while place + RECORD_HEAD.size <= size:
            self._file.seek(place)
            opcode, length = RECORD_HEAD.unpack(self._file.read(RECORD_HEAD.size))
            place += RECORD_HEAD.size
            if opcode == 0:
                # There is no such record: the file was made longer than what was written.
                return
            if opcode == Opcode.FOOTER:
                self.whole = place + length + len(MCAP_MAGIC) <= size
                return
            present = min(length, size - place)
            if opcode == Opcode.CHUNK:
                self._entries.append((opcode, place, present))
            elif present < length:
                return
            elif opcode == Opcode.MESSAGE:
                self._note_message(place, length)
            elif opcode == Opcode.MESSAGE_INDEX:
                self._note_index(place, length)
            elif opcode in _CATALOG:
                if length > RECORD_BYTES_MAX:
                    name = f"{self.path}: {Opcode(opcode).name}"
                    raise RecordingFormatError(f"{name}: {length} bytes; expected {RECORD_BYTES_MAX} at most")
                self._register(opcode, self._file.read(length))
            place += length

    def _note_message(self, place: int, length: int) -> None:
        """Note a message outside of chunks."""
        head = self._file.read(_MESSAGE_HEAD.size)
        if length >= _MESSAGE_HEAD.size:
            channel, _, log_time, _ = _MESSAGE_HEAD.unpack(head)
            times_ns = np.array([min(log_time, int(_TIME_MAX))], dtype=np.int64)
            self._found[channel].append(Run(len(self._entries), times_ns, np.zeros(1, np.int64)))
            self._entries.append((Opcode.MESSAGE, place, length))

    def _note_index(self, place: int, length: int) -> None:
        # One that is too large counts as missing.
        if self._entries and _INDEX_HEAD_BYTES < length <= CHUNK_RECORDS_MAX * _INDEX_ENTRY.itemsize:
            channel = int.from_bytes(self._file.read(2), "little")
            start, entries = place + _INDEX_HEAD_BYTES, length - _INDEX_HEAD_BYTES
            self._indexes[channel].append((len(self._entries) - 1, start, entries))

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
