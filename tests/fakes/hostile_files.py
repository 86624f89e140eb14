"""Small files made to exhaust or crash a reader."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from pathlib import Path

import lz4.frame
import zstandard
from mcap.opcode import Opcode

_MCAP_MAGIC = b"\x89MCAP0\r\n"
GIB = 1 << 30


def mcap_record(kind: int, content: bytes) -> bytes:
    """Return one record of an MCAP file."""
    return struct.pack("<BQ", kind, len(content)) + content


def mcap_chunk(compressed: bytes, declared_size: int, compression: str) -> bytes:
    """Return a chunk record that declares its uncompressed size."""
    word = compression.encode()
    head = struct.pack("<QQQII", 0, 0, declared_size, 0, len(word)) + word
    return mcap_record(Opcode.CHUNK, head + struct.pack("<Q", len(compressed)) + compressed)


def mcap_file(path: Path, records: Iterable[bytes]) -> Path:
    """Write an MCAP file of records."""
    footer = mcap_record(Opcode.FOOTER, bytes(20))
    path.write_bytes(
        b"".join([_MCAP_MAGIC, mcap_record(Opcode.HEADER, bytes(8)), *records, footer, _MCAP_MAGIC])
    )
    return path


def zeros(size: int, compression: str) -> bytes:
    """Return zeros compressed without their size in the header."""
    block = bytes(1 << 20)
    if compression == "zstd":
        compressor = zstandard.ZstdCompressor(level=1, write_content_size=False).compressobj()
        return b"".join([compressor.compress(block) for _ in range(size >> 20)]) + compressor.flush()
    with lz4.frame.LZ4FrameCompressor() as each:
        parts = [each.begin(), *(each.compress(block) for _ in range(size >> 20)), each.flush()]
    return b"".join(parts)


def png_chunk(kind: bytes, content: bytes) -> bytes:
    """Return one part of a PNG."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def black_png(width: int, height: int, bits: int = 16, extra: bytes = b"") -> bytes:
    """Return a black gray PNG."""
    body = _deflated_zeros((1 + width * bits // 8) * height)
    head = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    parts = [png_chunk(b"IHDR", head), extra, png_chunk(b"IDAT", body), png_chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def _deflated_zeros(size: int) -> bytes:
    """Return zeros as zlib deflates them, without going through gigabytes: full flushes make parts alike."""
    flushed, last = (zlib.compressobj(9, wbits=-zlib.MAX_WBITS) for _ in range(2))
    part = flushed.compress(bytes(1 << 20)) + flushed.flush(zlib.Z_FULL_FLUSH)
    rest = last.compress(bytes(size % (1 << 20))) + last.flush()
    # The checksum's two sums, modulo 65521, are those of as many zeros.
    return b"\x78\xda" + part * (size >> 20) + rest + struct.pack(">HH", size % 65521, 1)


def tiff(
    width: int, height: int, *, strip_rows: int | None = None, channels: int = 1, bits: int = 16
) -> bytes:
    """Return a TIFF of one strip that says these sizes and holds a few bytes."""
    tags = [
        (256, width), (257, height), (258, bits), (259, 1), (262, 1), (273, 200), (277, channels),
        (278, height if strip_rows is None else strip_rows), (279, 64),
    ]  # fmt: skip
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return (struct.pack("<4sIH", b"II*\0", 8, len(tags)) + entries + bytes(4)).ljust(200, b"\0") + bytes(64)


__all__ = ["GIB", "black_png", "mcap_chunk", "mcap_file", "mcap_record", "png_chunk", "tiff", "zeros"]
