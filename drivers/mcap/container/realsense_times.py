"""The times of RealSense's own recordings (``.db3``), whose messages have no stamps of use.

A topic of texts beside each stream of images says when each was taken, by the device's clock.
"""

import re
import sqlite3
import struct
from collections.abc import Iterable

from nurbseg.common.limits import STAMP_END_NS

_METADATA, _TEXT = "/image/metadata", "std_msgs/msg/String"
_TIMESTAMP = re.compile(rb";timestamp=(\d{1,15}(?:\.\d{1,9})?)")
#: Seconds and nanoseconds of a message that begins with a header, after the 4 bytes that say its byte order.
_STAMP_PLACE = 4


def device_times(
    base: sqlite3.Connection, topics: Iterable[tuple[int, str, str]]
) -> dict[int, dict[int, int]]:
    """Return the device's times by those of the log, nanoseconds, for topics of images, by number.

    `topics` are the numbers, names and types of all topics.
    """
    found: dict[int, dict[int, int]] = {}
    every = list(topics)
    for number, name, kind in every:
        if not name.endswith(_METADATA) or kind != _TEXT:
            continue
        query = "SELECT timestamp, substr(data, 1, 4096) FROM messages WHERE topic_id = ?"
        times = {}
        for log_ns, content in base.execute(query, (number,)):
            match = _TIMESTAMP.search(content) if isinstance(content, bytes) else None
            if match is not None and (time_ns := round(1e6 * float(match[1]))) < STAMP_END_NS:
                times[log_ns] = time_ns
        images = [each for each, image, _ in every if image.startswith(name.removesuffix("metadata"))]
        found |= dict.fromkeys(set(images) - {number}, times)
    return found


def restamped(content: bytes, time_ns: int) -> bytes:
    """Return a message with another time in its header."""
    order = "<" if content[1] & 1 else ">"
    stamp = struct.pack(f"{order}iI", *divmod(time_ns, 1_000_000_000))
    return content[:_STAMP_PLACE] + stamp + content[_STAMP_PLACE + len(stamp) :]
