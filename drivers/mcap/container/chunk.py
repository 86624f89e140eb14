"""The records in a chunk of an MCAP file, decompressed within limits and checked."""

import struct
import zlib
from collections.abc import Iterator

from mcap.records import Chunk

from nurbseg.common.limits import CHUNK_BYTES_MAX, CHUNK_RECORDS_MAX

#: Of each record: its kind, and the length of its content.
RECORD_HEAD = struct.Struct("<BQ")
#: No message begins so: its first byte is 0.
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def chunk_records(chunk: Chunk) -> Iterator[tuple[int, bytes]]:
    """Yield the kind and content of each record of a chunk.

    The library's own `breakup_chunk` trusts what the compressed data and the records say of their sizes.
    Raises ValueError, or what the decompressor raises, if it is damaged or too large.
    """
    size = chunk.uncompressed_size
    if size > CHUNK_BYTES_MAX:
        raise ValueError(f"uncompressed_size: {size} bytes; expected {CHUNK_BYTES_MAX} at most")
    content = _decompressed(chunk.data, chunk.compression, size)
    if len(content) != size:
        there = "more" if len(content) > size else f"{len(content)} bytes"
        raise ValueError(f"uncompressed_size: {size} bytes are declared, {there} are there")
    if chunk.uncompressed_crc not in (0, zlib.crc32(content)):
        raise ValueError("the checksum is wrong")
    end = number = 0
    while end + RECORD_HEAD.size <= size:
        kind, length = RECORD_HEAD.unpack_from(content, end)
        start, end, number = end + RECORD_HEAD.size, end + RECORD_HEAD.size + length, number + 1
        if kind == 0 or end > size or number > CHUNK_RECORDS_MAX:
            raise ValueError(f"record {number}: of the kind {kind}, {length} bytes")
        yield kind, content[start:end]


def whole_message(content: bytes) -> bytes:
    """Return a message, which ``ros2 bag`` may have compressed by itself.

    Raises ValueError, or what the decompressor raises, if it is damaged or too large.
    """
    if not content.startswith(_ZSTD_MAGIC):
        return content
    return _decompressed(content, "zstd", CHUNK_BYTES_MAX)


def _decompressed(content: bytes, compression: str, size: int) -> bytes:
    """Return the decompressed content, of which at most `size` + 1 bytes are made.

    Raises ValueError, or what the decompressor raises, if it is damaged or states that it is larger.
    """
    if compression == "lz4":
        import lz4.frame  # late, as zstandard: of mcap

        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=size + 1))
    if compression == "zstd":
        import zstandard

        # One call takes half the time of a stream; it allocates what the frame states.
        stated = zstandard.frame_content_size(content)
        if stated > size:
            raise ValueError(f"{size} bytes are declared, {stated} are there")
        return zstandard.ZstdDecompressor().decompress(content, max_output_size=max(1, size))
    if compression:
        raise ValueError(f"compression: expected zstd, lz4 or none, got {compression!r}")
    return content
