"""Walks through the elements of a Matroska file: each has a kind, a size and a content [1]_.

Only their heads are read, so that a file of any size is listed in little time and memory.

References
----------
.. [1] RFC 8794, "Extensible Binary Meta Language", and RFC 9559, "Matroska Media Container Format".
"""

import os
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

SEGMENT, CLUSTER, BLOCK_GROUP = 0x18538067, 0x1F43B675, 0xA0
#: An element's kind has 4 bytes at most, and its size 8; and as much is read at once.
_HEAD_BYTES, _READ_BYTES = 12, 32
#: Elements of a file; a recording of hours has a million.
_ELEMENTS_MAX = 5_000_000


class Element(NamedTuple):
    """An element: what it is, from where to where its content is in the file, and 20 bytes of it."""

    kind: int
    start: int
    end: int
    first: bytes


def walk(stream: BinaryIO, size: int) -> Iterator[Element]:
    """Yield the elements of a file, also those within its segment, clusters and groups of blocks.

    Raises ValueError where there is no element, or only a part of it.
    """
    place = count = 0
    while place < size:
        count += 1
        if count > _ELEMENTS_MAX:
            raise ValueError(f"expected {_ELEMENTS_MAX} elements at most")
        head = os.pread(stream.fileno(), _READ_BYTES, place)
        kind, length, content_size = _head(head, place)
        start = place + length
        # What holds others is entered: those that are written live state no size.
        is_entered = kind in (SEGMENT, CLUSTER, BLOCK_GROUP)
        if content_size is None and not is_entered:
            raise ValueError(f"the element at byte {place} has no size")
        place = start if is_entered else start + (content_size or 0)
        if place > size:
            raise ValueError(f"the file is cut off after {size} bytes")
        yield Element(kind, start, place, head[length:])


def fields(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the kinds and contents of the elements within one; raises ValueError if it is damaged."""
    place = 0
    while place < len(content):
        kind, length, size = _head(content[place : place + _HEAD_BYTES], place)
        end = place + length + (size or 0)
        if size is None or end > len(content):
            raise ValueError(f"the element at byte {place} of another is longer than it")
        yield kind, content[place + length : end]
        place = end


def unsigned(content: bytes) -> int:
    """Return a whole number; raises ValueError if it has more than 8 bytes."""
    if len(content) > 8:
        raise ValueError(f"expected a number of 8 bytes at most, got {len(content)}")
    return int.from_bytes(content)


def variable(head: bytes, place: int = 0) -> tuple[int, int]:
    """Return a number whose first bits say how many bytes it has, without these bits, and its bytes."""
    first = head[place] if place < len(head) else 0
    length = 9 - first.bit_length()
    if length > 8 or place + length > len(head):
        raise ValueError("a number is damaged or cut off")
    return int.from_bytes(head[place : place + length]) & ((1 << 7 * length) - 1), length


def _head(head: bytes, place: int) -> tuple[int, int, int | None]:
    """Return an element's kind, the bytes of its head, and the size of its content; None if not stated."""
    try:
        _, kind_bytes = variable(head)
        if kind_bytes > 4:
            raise ValueError("its kind is none")
        size, size_bytes = variable(head, kind_bytes)
    except ValueError as err:
        raise ValueError(f"the element at byte {place} is damaged ({err})") from err
    # All ones: until the next one that cannot be within it.
    stated = None if size == (1 << 7 * size_bytes) - 1 else size
    return int.from_bytes(head[:kind_bytes]), kind_bytes + size_bytes, stated
