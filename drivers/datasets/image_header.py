"""Reads the size of an encoded image from its header, before anything is decoded."""

import re
import struct

from nurbseg.drivers.errors import FrameFormatError
from nurbseg.drivers.limits import PIXELS_MAX

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"
_TIFF_MAGICS = {b"II*\0": "<", b"MM\0*": ">"}
#: Start-of-frame markers of JPEG: all of C0 to CF but the tables C4, C8 and CC.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
#: Each scan of a progressive JPEG goes over the whole image; encoders make about ten.
_JPEG_SCANS_MAX = 100
_PNM_HEADER = re.compile(rb"P[56]\s(?:\s*#[^\n]*\n)*\s*(\d{1,9})\s+(\d{1,9})\s+(\d{1,5})\s")
_PNM_HEADER_BYTES = 4096
# Tags of TIFF that say how much is decoded at a time.
_WIDTH, _HEIGHT, _BITS, _SAMPLES, _STRIP_ROWS, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 277, 278, 322, 323
_TIFF_TYPES = {3: "H", 4: "I"}


def pnm_header(content: bytes, name: str) -> tuple[int, int, int, int]:
    """Return the width, height, maximum and length of the header of a binary PGM or PPM.

    Raises FrameFormatError if it has no such header.
    """
    header = _PNM_HEADER.match(content[:_PNM_HEADER_BYTES])
    if header is None:
        raise FrameFormatError(f"{name}: expected a binary PGM or PPM with width, height and maximum")
    width, height, maximum = map(int, header.groups())
    return width, height, maximum, header.end()


def check_size(content: bytes, name: str) -> None:
    """Refuse an encoded image that is of no known form, or too large to be decoded.

    Raises FrameFormatError if it is not PNG, JPEG, TIFF, PGM, PPM or BMP, its header is damaged, or it has
    more pixels than `nurbseg.drivers.limits.PIXELS_MAX`.
    """
    try:
        width, height = _size(content, name)
    except (struct.error, IndexError) as err:
        raise FrameFormatError(f"{name}: the image is cut off within its header") from err
    if width < 1 or height < 1 or width * height > PIXELS_MAX:
        raise FrameFormatError(
            f"{name}: width, height: expected 1 to {PIXELS_MAX} pixels in all, got {width} x {height}"
        )


def _size(content: bytes, name: str) -> tuple[int, int]:
    if content.startswith(PNG_MAGIC):
        width, height = struct.unpack_from(">II", content, len(PNG_MAGIC) + 8)
        return width, height
    if content.startswith(JPEG_MAGIC):
        return _jpeg_size(content, name)
    if content[:2] in (b"P5", b"P6"):
        return pnm_header(content, name)[:2]
    if content.startswith(b"BM"):
        old = struct.unpack_from("<I", content, 14)[0] == 12
        width, height = struct.unpack_from("<HH" if old else "<ii", content, 18)
        # Rows run downwards where the height is negative.
        return width, abs(height)
    if content[:4] in _TIFF_MAGICS:
        return _tiff_size(content, _TIFF_MAGICS[content[:4]], name)
    raise FrameFormatError(f"{name}: not an image that can be decoded (PNG, JPEG, TIFF, PGM, PPM, BMP)")


def _jpeg_size(content: bytes, name: str) -> tuple[int, int]:
    # Within the coded image FF DA does not occur: FF is followed by 0 there.
    if content.count(b"\xff\xda") > _JPEG_SCANS_MAX:
        raise FrameFormatError(f"{name}: the JPEG has more than {_JPEG_SCANS_MAX} scans")
    place = 2
    while True:
        if content[place] != 0xFF:
            raise FrameFormatError(f"{name}: the JPEG is damaged at byte {place}")
        marker = content[place + 1]
        if marker == 0xFF:
            place += 1
        elif marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", content, place + 5)
            return width, height
        else:
            place += 2 + struct.unpack_from(">H", content, place + 2)[0]


def _tiff_size(content: bytes, order: str, name: str) -> tuple[int, int]:
    """Return the size of the first image, or of the strip or tile that is decoded at once, if larger."""
    place = struct.unpack_from(f"{order}I", content, 4)[0]
    tags: dict[int, int] = {}
    for number in range(struct.unpack_from(f"{order}H", content, place)[0]):
        tag, kind, count = struct.unpack_from(f"{order}HHI", content, place + 2 + 12 * number)
        code = _TIFF_TYPES.get(kind)
        if code is None:
            continue
        at = place + 10 + 12 * number
        if count * struct.calcsize(code) > 4:
            at = struct.unpack_from(f"{order}I", content, at)[0]
        if tag in (_WIDTH, _HEIGHT, _BITS, _SAMPLES, _STRIP_ROWS, _TILE_WIDTH, _TILE_HEIGHT) and count:
            value = struct.unpack_from(f"{order}{code}", content, at)[0]
            tags[tag] = max(value, tags.get(tag, 0))
    if tags.get(_SAMPLES, 1) > 4 or tags.get(_BITS, 1) > 32:
        raise FrameFormatError(f"{name}: expected a TIFF of up to 4 channels of up to 32 bits")
    width, height = tags.get(_WIDTH, 0), tags.get(_HEIGHT, 0)
    rows = tags.get(_STRIP_ROWS, 0)
    # All ones: the whole image in one strip.
    decoded = [(width, height), (width, 0 if rows == 0xFFFFFFFF else rows)]
    decoded.append((tags.get(_TILE_WIDTH, 0), tags.get(_TILE_HEIGHT, 0)))
    return max(decoded, key=lambda size: size[0] * size[1])
