"""Bags of ROS 2 that are SQLite databases (``.db3``)."""

import os
import re
import shlex
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import FrameFormatError, RecordingFormatError, quoted
from nurbseg.common.files import open_regular
from nurbseg.common.limits import CHUNK_BYTES_MAX
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.container.messages import MessageFile, Stored, Topic, whole_message

#: The size of a page and the number of pages, in the file's head.
_HEAD = struct.Struct(">16xH10xI")
_PAGE_MAX = 65_536
#: What a damaged database raises; the library decodes its own messages, which quote the file.
_FAILURES = (sqlite3.Error, OverflowError, MemoryError, UnicodeDecodeError)
#: Topics of texts in the recordings of RealSense's SDK, and the device's time in one, milliseconds.
_METADATA, _DEVICE_MS = "/image/metadata", re.compile(rb";timestamp=(\d{1,15}(?:\.\d{1,9})?)")


class DatabaseFile(MessageFile):
    """A ``.db3`` opened for reading; it is not changed.

    Raises RecordingFormatError if it is no such database, or not whole.
    """

    form = "ROS 2 bag (.db3)"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        old, new = (shlex.quote(str(each)) for each in (path, path.with_suffix(".repaired.db3")))
        self._repair = f"to save what is there: sqlite3 {old} .recover | sqlite3 {new}"
        # Refuses what is no regular file before the library waits for it.
        with open_regular(path) as stream:
            head, size = stream.read(_HEAD.size), os.fstat(stream.fileno()).st_size
        page, pages = _HEAD.unpack(head.ljust(_HEAD.size, b"\0"))
        if (_PAGE_MAX if page == 1 else page) * pages > size:
            raise RecordingFormatError(f"{path}: the database is cut off after {size} bytes; {self._repair}")
        # Without a log of changes to merge, nothing beside the file is read or made.
        log = path.with_name(path.name + "-wal")
        mode = "mode=ro" if log.exists() and log.stat().st_size else "mode=ro&immutable=1"
        try:
            self._base = sqlite3.connect(
                f"{path.absolute().as_uri()}?{mode}", uri=True, check_same_thread=False
            )
        except sqlite3.Error as err:
            raise RecordingFormatError(f"{path}: the database cannot be opened ({err})") from err
        with closed_on_error(self._base.close):
            self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, CHUNK_BYTES_MAX)
            self._base.text_factory = lambda content: content.decode(errors="replace")
            self._numbers = self._found_topics()

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._base.close()

    def _found_topics(self) -> dict[str, list[int]]:
        """Set the topics; return their numbers in the database."""
        tables = {name for (name,) in self._rows("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if missing := {"topics", "messages"} - tables:
            raise RecordingFormatError(
                f"{self.path}: not a bag of ROS 2: {min(missing)}: expected a table, got nothing"
            )
        counts = dict(self._rows("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        numbers: dict[str, list[int]] = {}
        rows = self._rows("SELECT id, name, type, serialization_format FROM topics")
        for number, name, kind, encoding in rows:
            if not all(isinstance(each, str) for each in (name, kind, encoding)):
                raise RecordingFormatError(f"{self.path}: topics: expected text, got {quoted((name, kind))}")
            if number not in counts:
                continue
            numbers.setdefault(name, []).append(number)
            self.topics[name] = Topic(kind, encoding, sum(counts[each] for each in numbers[name]))
        ((first_ns, last_ns),) = self._rows("SELECT min(timestamp), max(timestamp) FROM messages")
        self.span_ns = last_ns - first_ns if type(first_ns) is type(last_ns) is int else 0
        #: The stamps in RealSense's recordings are times of arrival; the device's are in texts beside them.
        self._device_ns: dict[int, dict[int, int]] = {}
        for number, name, *_ in rows:
            if name.endswith(_METADATA):
                text = "CAST(substr(data, 1, 4096) AS BLOB)"
                texts = self._rows(f"SELECT timestamp, {text} FROM messages WHERE topic_id = ?", number)
                found = ((log_ns, _DEVICE_MS.search(text or b"")) for log_ns, text in texts)
                times = {log_ns: round(1e6 * float(match[1])) for log_ns, match in found if match}
                images = name.removesuffix("metadata")
                self._device_ns |= {each: times for each, image, *_ in rows if image.startswith(images)}
        return numbers

    def _of_topic(self, topic: str, after: int | None) -> Iterator[Stored]:
        numbers = self._numbers.get(topic, [])
        marks = ", ".join("?" * len(numbers))
        query = f"SELECT rowid, topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks})"
        place = -1 if after is None else after
        try:
            rows = self._base.execute(f"{query} AND rowid > ? ORDER BY rowid", (*numbers, place))
            for place, number, log_ns, content in rows:
                yield self._stored(place, number, log_ns, content)
        except _FAILURES as err:
            text = f"{self.path}: the database cannot be read after message {place} ({quoted(str(err))})"
            yield Stored(place, 0, FrameFormatError(f"{text}; {self._repair}"))

    def _stored(self, place: int, topic: int, log_ns: Any, content: Any) -> Stored:
        try:
            if type(log_ns) is not int or type(content) is not bytes:
                raise ValueError("expected a time and bytes")
            message = whole_message(content)
            if (device_ns := self._device_ns.get(topic, {}).get(log_ns)) is not None:
                message = ros.restamped(message, device_ns)
        except Exception as err:  # The decompressor raises errors of many kinds for damage.
            text = f"{self.path}: message {place}: damaged ({quoted(str(err))})"
            return Stored(place, 0, FrameFormatError(text))
        return Stored(place, log_ns, message)

    def _rows(self, query: str, *values: Any) -> list[Any]:
        try:
            return self._base.execute(query, values).fetchall()
        except _FAILURES as err:
            raise RecordingFormatError(
                f"{self.path}: the ROS 2 database cannot be read ({quoted(str(err))}); {self._repair}"
            ) from err
