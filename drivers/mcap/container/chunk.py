"""Decompresses a chunk of an MCAP file, and goes through its records."""

import struct
import zlib
from collections.abc import Iterator

import lz4.frame
import zstandard

from nurbseg.common.errors import FrameFormatError, quoted
from nurbseg.common.limits import CHUNK_BYTES_MAX, CHUNK_RECORDS_MAX

#: Of each record: its kind, and the length of its content.
RECORD_HEAD = struct.Struct("<BQ")
#: No message begins so: its first byte is 0.
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_CHUNK_HEAD = struct.Struct("<QQQII")


def chunk_records(content: bytes, name: str) -> Iterator[tuple[int, int, int]]:
    """Yield the kind of each whole record, and where its content starts and ends.

    Raises FrameFormatError, which calls the chunk `name`, at a record that cannot be.
    """
    place = 0
    number = 0
    while place + RECORD_HEAD.size <= len(content):
        opcode, length = RECORD_HEAD.unpack_from(content, place)
        place += RECORD_HEAD.size
        if place + length > len(content):
            return
        number += 1
        if number > CHUNK_RECORDS_MAX or opcode == 0:
            raise FrameFormatError(
                f"{name}: records: expected {CHUNK_RECORDS_MAX} at most and none of the kind 0, "
                f"got the kind {opcode} in place {number}"
            )
        yield opcode, place, place + length
        place += length


def chunk_content(content: bytes, name: str) -> bytes:
    """Return the uncompressed records of a chunk, or of as much of it as there is.

    Raises FrameFormatError, which calls the chunk `name`, if it is damaged or too large.
    """
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


def whole_message(content: bytes, name: str) -> bytes:
    """Return a message, which ``ros2 bag`` may have compressed by itself.

    Raises FrameFormatError, which calls it `name`, if it cannot be decompressed, or is too large.
    """
    if not content.startswith(_ZSTD_MAGIC):
        return content
    try:
        found = _decompressed(content, "zstd", CHUNK_BYTES_MAX, name)
    except (zstandard.ZstdError, MemoryError) as err:
        raise FrameFormatError(f"{name}: cannot be decompressed ({err})") from err
    if len(found) > CHUNK_BYTES_MAX:
        raise FrameFormatError(f"{name}: over {CHUNK_BYTES_MAX} bytes")
    return found
