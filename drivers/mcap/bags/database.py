"""Reads bags of ROS 2 that are SQLite databases (``.db3``), of ``ros2 bag`` and RealSense's SDK."""

import logging
import os
import re
import sqlite3
import struct
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message, Schema
from numpy.typing import NDArray

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import open_regular
from nurbseg.common.limits import (
    CATALOG_BYTES_MAX,
    CHUNK_BYTES_MAX,
    MESSAGES_MAX,
    RECORD_BYTES_MAX,
    STAMP_END_NS,
)
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.bag import MessageFile, Run
from nurbseg.drivers.mcap.container.chunk import whole_message

_log = logging.getLogger(__name__)

#: Columns that the tables must have.
_TABLES = {"topics": ("id", "name", "type"), "messages": ("topic_id", "timestamp", "data")}
#: Words of the definition of a table that is computed, or whose rows have no numbers.
_UNUSUAL = ("CREATE VIRTUAL", "WITHOUT ROWID")
_TOPICS_MAX = 1_000
#: Rows that are fetched at a time.
_ROWS = 4096
#: Instructions of the database after which a query is given up: some minutes.
_INSTRUCTIONS, _LOOKS = 1 << 32, 64
#: The size of a page and the number of pages, in the file's head.
_HEAD = struct.Struct(">16xH10xI")


class _MalformedError(RecordingFormatError):
    """The database cannot be read further."""


class DatabaseFile(MessageFile):
    """A ``.db3`` opened for reading.

    The messages are one entry, and the offset of a message is its number in the table. The database is not
    changed, and nothing that it defines is run: views, triggers and computed columns are refused. Raises
    RecordingFormatError if it is no such database.
    """

    form = "ROS 2 bag (.db3)"
    has_chunks = False

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._runs: dict[int, list[Run]] = {}
        #: By topic and log time, of RealSense's.
        self._device_ns: dict[int, dict[int, int]] = {}
        # Refuses what is no regular file before the library waits for it.
        with open_regular(path) as stream:
            head = stream.read(_HEAD.size)
            self._is_cut_off = (
                len(head) < _HEAD.size or _stated_size(head) > os.fstat(stream.fileno()).st_size
            )
        beside = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
        # What was not merged yet is read too; else nothing beside the file is looked at or made.
        is_merged = not beside[0].exists() or beside[0].stat().st_size == 0
        mode = "mode=ro&immutable=1" if is_merged else "mode=ro"
        try:
            self._base = sqlite3.connect(
                f"{path.absolute().as_uri()}?{mode}", uri=True, check_same_thread=False
            )
        except sqlite3.Error as err:
            raise RecordingFormatError(f"{path}: the database cannot be opened ({err})") from err
        with closed_on_error(self._base.close):
            self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, RECORD_BYTES_MAX)
            # One that is cut off is read as far as it goes; nothing is written.
            self._base.execute("PRAGMA writable_schema=ON")
            self._base.execute("PRAGMA trusted_schema=OFF")
            self._base.text_factory = lambda content: content.decode(errors="replace")
            self._base.set_progress_handler(self._count, _INSTRUCTIONS // _LOOKS)
            self._check_tables()
            self._learn_topics()
            self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, CHUNK_BYTES_MAX)
        if beside[1].exists():
            _log.warning("%s: was not closed (%s is beside it)", path, beside[1].name)

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._base.close()

    def find_messages(self) -> None:
        """Note the times of all messages; a database that is cut off or damaged is read as far as it goes."""
        if self._runs:
            return
        parts: dict[int, list[NDArray[np.int64]]] = {topic: [] for topic in self.channels}
        rows: list[Any] = []

        def put_away() -> None:
            table = np.array(rows, dtype=np.int64).reshape(-1, 3)
            rows.clear()
            for topic in np.unique(table[:, 1]).tolist():
                if topic in parts:
                    parts[topic].append(table[table[:, 1] == topic][:, [2, 0]])

        found = 0
        try:
            query = "SELECT rowid, topic_id, timestamp FROM messages ORDER BY rowid"
            with closing(self._each(query)) as listed:
                for row in listed:
                    if not all(type(value) is int for value in row):
                        # Of pages that are missing, nothing is read.
                        error = _MalformedError if self._is_cut_off else RecordingFormatError
                        raise error(f"{self.path}: messages: expected whole numbers, got {quoted(row)}")
                    rows.append(row)
                    found += 1
                    if found > MESSAGES_MAX:
                        raise RecordingFormatError(f"{self.path}: messages: expected {MESSAGES_MAX} at most")
                    if len(rows) == _ROWS:
                        put_away()
        except _MalformedError as err:
            self.whole = False
            _log.warning("%s; it is replayed up to there, message %d", err, found)
        put_away()
        for topic, tables in parts.items():
            if tables:
                times_ns, numbers = np.concatenate(tables).T
                self._runs[topic] = [Run(0, times_ns, numbers)]
        topics = {
            number: (channel.topic, self.schemas[channel.schema_id].name)
            for number, channel in self.channels.items()
        }
        for text, images in texts_of(topics).items():
            query = "SELECT timestamp, substr(data, 1, 4096) FROM messages WHERE topic_id = ?"
            with suppress(_MalformedError):
                times = device_times(self._each(query, text))
                self._device_ns |= dict.fromkeys(images, times)

    def runs(self, channel: int) -> Iterator[Run]:
        """Yield the messages of a channel."""
        self.find_messages()
        yield from self._runs.get(channel, [])

    def message(self, entry: int, offset: int) -> Message:
        """Return a message; raises FrameFormatError if it cannot be read."""
        name = f"{self.path}: message {offset}"
        try:
            rows = self._rows("SELECT topic_id, timestamp, data FROM messages WHERE rowid = ?", offset)
        except RecordingFormatError as err:
            raise FrameFormatError(f"{name}: {str(err).removeprefix(f'{self.path}: ')}") from err
        if len(rows) != 1 or type(rows[0][2]) is not bytes:
            raise FrameFormatError(f"{name}: data: expected bytes")
        topic, time_ns, content = rows[0]
        content = whole_message(content, name)
        if len(content) > 12 and (device_ns := self._device_ns.get(topic, {}).get(time_ns)) is not None:
            content = restamped(content, device_ns)
        return Message(channel_id=topic, sequence=0, log_time=time_ns, publish_time=time_ns, data=content)

    def _check_tables(self) -> None:
        rows = self._rows("SELECT name, type, sql FROM sqlite_master LIMIT 1000")
        kinds = {name: (kind, str(sql)) for name, kind, sql in rows}
        for table, columns in _TABLES.items():
            kind, sql = kinds.get(table, ("nothing", ""))
            if kind == "table" and any(each in sql.upper() for each in _UNUSUAL):
                kind = "a table of another kind"
            if kind != "table":
                raise RecordingFormatError(
                    f"{self.path}: not a bag of ROS 2: {table}: expected a table, got {kind}"
                )
            # The last value is over 1 of a computed column.
            listed = {name: hidden for _, name, *_, hidden in self._rows(f"PRAGMA table_xinfo({table})")}
            for column in columns:
                if listed.get(column) != 0:
                    raise RecordingFormatError(
                        f"{self.path}: not a bag of ROS 2: {table}: expected a column {column}"
                    )

    def _learn_topics(self) -> None:
        definitions: dict[str, tuple[str, str]] = {}
        tables = self._rows("SELECT name FROM sqlite_master WHERE type = 'table' LIMIT 1000")
        if ("message_definitions",) in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT ?"
            listed = self._catalog(query)
            definitions = {str(kind): (str(form), str(text)) for kind, form, text in listed}
        columns = {name for _, name, *_ in self._rows("PRAGMA table_xinfo(topics)")}
        form = "serialization_format" if "serialization_format" in columns else "'cdr'"
        topics = self._catalog(f"SELECT id, name, type, {form} FROM topics LIMIT ?")
        for number, (topic, name, kind, encoding) in enumerate(topics):
            if type(topic) is not int or not all(isinstance(each, str) for each in (name, kind, encoding)):
                raise RecordingFormatError(
                    f"{self.path}: topics: expected a number and text, got {quoted((topic, name, kind))}"
                )
            # Older bags do not say it; the common messages were never changed.
            written, text = definitions.get(kind, ("", ""))
            if not text:
                written, text = "ros2msg", ros.DEFINITIONS.get(kind, "")
            self.schemas[number] = Schema(id=number, name=kind, encoding=written, data=text.encode())
            self.channels[topic] = Channel(
                id=topic, topic=name, message_encoding=encoding, metadata={}, schema_id=number
            )

    def _catalog(self, query: str) -> list[Any]:
        left, found = CATALOG_BYTES_MAX, []
        with closing(self._each(query, _TOPICS_MAX)) as rows:
            for row in rows:
                left -= sum(len(value) for value in row if isinstance(value, str | bytes))
                if left < 0:
                    what = f"over {CATALOG_BYTES_MAX} bytes of topics and definitions"
                    raise RecordingFormatError(f"{self.path}: {what}")
                found.append(row)
        return found

    def _rows(self, query: str, *values: int) -> list[Any]:
        return list(self._each(query, *values))

    def _each(self, query: str, *values: int) -> Generator[Any, None, None]:
        """Yield the rows of a query.

        Raises RecordingFormatError if the database is damaged, or takes very long.
        """
        self._calls = 0
        try:
            yield from self._base.execute(query, values)
        except (sqlite3.Error, OverflowError, MemoryError) as err:
            if "interrupted" in str(err):
                raise RecordingFormatError(f"{self.path}: the ROS 2 database takes too long to read") from err
            raise _MalformedError(f"{self.path}: the ROS 2 database cannot be read further ({err})") from err

    def _count(self) -> bool:
        self._calls += 1
        return self._calls > _LOOKS


def _stated_size(head: bytes) -> int:
    page, pages = _HEAD.unpack(head)
    return int(pages) * (65536 if page == 1 else int(page))


_METADATA, _TEXT = "/image/metadata", "std_msgs/msg/String"
_TIMESTAMP = re.compile(rb";timestamp=(\d{1,15}(?:\.\d{1,9})?)")
#: Seconds and nanoseconds of a message that begins with a header, after the 4 bytes that say its byte order.
_STAMP_PLACE = 4


def texts_of(topics: Mapping[int, tuple[str, str]]) -> dict[int, list[int]]:
    """Return the topics with such texts, and those whose images they describe, by number.

    `topics` are names and types.
    """
    return {
        number: [
            other
            for other, (image, _) in topics.items()
            if other != number and image.startswith(name.removesuffix("metadata"))
        ]
        for number, (name, kind) in topics.items()
        if name.endswith(_METADATA) and kind == _TEXT
    }


def device_times(rows: Iterable[tuple[int, object]]) -> dict[int, int]:
    """Return the device's times by those of the log, nanoseconds, of rows with log time and text."""
    found = {}
    for log_ns, content in rows:
        if isinstance(content, bytes) and (match := _TIMESTAMP.search(content)) is not None:
            time_ns = round(1e6 * float(match[1]))
            if time_ns < STAMP_END_NS:
                found[log_ns] = time_ns
    return found


def restamped(content: bytes, time_ns: int) -> bytes:
    """Return a message with another time in its header."""
    order = "<" if content[1] & 1 else ">"
    stamp = struct.pack(f"{order}iI", *divmod(time_ns, 1_000_000_000))
    return content[:_STAMP_PLACE] + stamp + content[_STAMP_PLACE + len(stamp) :]
