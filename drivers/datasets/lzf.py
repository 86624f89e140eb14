"""LZF decompression, which compressed PCD files need."""

from __future__ import annotations


def decompress(content: bytes, size: int) -> bytes:
    """Decompress an LZF block: runs of literal bytes, and references back of 3 to 264 bytes.

    Raises ValueError if it is damaged, or other than `size` bytes come out.

    References
    ----------
    .. [1] M. Lehmann, LibLZF, http://oldhome.schmorp.de/marc/liblzf.html
    """
    out = bytearray()
    place, end = 0, len(content)
    try:
        while place < end:
            control = content[place]
            place += 1
            if control < 32:
                out += content[place : place + control + 1]
                place += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += content[place]
                place += 1
            distance = ((control & 31) << 8) + content[place] + 1
            place += 1
            start = len(out) - distance
            if start < 0:
                raise ValueError(f"a reference reaches {-start} bytes before the beginning")
            length += 2
            if distance >= length:
                out += out[start : start + length]
            else:
                # The copy runs into what it writes: a repeated pattern.
                out += (out[start:] * (length // distance + 1))[:length]
            if len(out) > size:
                break
    except IndexError:
        raise ValueError("the block ends within a reference") from None
    if len(out) != size or place > end:
        raise ValueError(f"expected {size} bytes, got {len(out)}")
    return bytes(out)
