"""The device's time of images in RealSense's databases, whose headers have the time of arrival.

Beside each image there is a text, logged at the same time: ``Frame number=7;...;timestamp=233.100000;...``,
milliseconds.
"""

import re
import struct
from collections.abc import Iterable, Mapping

from nurbseg.common.limits import STAMP_END_NS

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
