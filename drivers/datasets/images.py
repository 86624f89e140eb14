"""Decodes color, depth and label images, and reports what is wrong with one that cannot be used."""

import io
import math
import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError, quoted
from nurbseg.common.limits import FRAME_BYTES_MAX, PIXELS_MAX
from nurbseg.drivers.calibration.foreign import HEAD_BYTES, what_it_is

#: Gray level of color images that there are none of.
GRAY = 128
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_JPEG_MAGIC = b"\xff\xd8\xff"
_TIFF_MAGICS = {b"II*\0": "<", b"MM\0*": ">"}
#: Start-of-frame markers of JPEG: all of C0 to CF but the tables C4, C8 and CC.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
#: Each scan of a progressive JPEG goes over the whole image; encoders make about ten.
_JPEG_SCANS_MAX = 100
_PNM_HEADER = re.compile(rb"P[56]\s(?:\s*#[^\n]*\n)*\s*(\d{1,9})\s+(\d{1,9})\s+(\d{1,5})\s")
_PNM_HEADER_BYTES = 4096
# Tags of TIFF that say how much is decoded at a time, ...
_WIDTH, _HEIGHT, _BITS, _SAMPLES, _STRIP_ROWS, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 277, 278, 322, 323
# ... and what its pixels are; and here, where the tags of the next image are.
_REDUCED, _COLORS, _ORIENTATION, _EXTRA, _AFTER = 254, 262, 274, 338, 0
#: Gray, RGB, a palette, CMYK and YCbCr: of others, decoders take the numbers for RGB.
_TIFF_COLORS = (0, 1, 2, 3, 5, 6)
_TIFF_TYPES = {3: "H", 4: "I"}
#: Bytes after the end-of-image marker that some cameras add.
_JPEG_TRAILER = 4096
#: Texts, profiles and animation of a PNG, which may be far larger decompressed and are of no use here.
_PNG_PASSED_OVER = frozenset((b"tEXt", b"zTXt", b"iTXt", b"iCCP", b"eXIf", b"acTL", b"fcTL", b"fdAT"))
#: The color types of a PNG with a palette, and of gray levels.
_PALETTE, _GRAY_LEVELS = b"\3", b"\0"
#: Encoders make parts of 8 kB or more.
_PNG_PARTS_MAX = 65_536


def _checked(content: bytes, name: str) -> bytes:
    """Check that an image is not too large, cut off or damaged, which decoders may ignore.

    Returns what is to be decoded: a PNG without its texts and animation.
    """
    if not content:
        raise FrameFormatError(f"{name}: the image is empty (0 bytes)")
    _check_size(content, name)
    if content.startswith(_PNG_MAGIC):
        parts = [part for kind, part in _png_parts(content, name) if kind not in _PNG_PASSED_OVER]
        return b"".join([_PNG_MAGIC, *parts])
    if content.startswith(_JPEG_MAGIC) and b"\xff\xd9" not in content[-_JPEG_TRAILER:]:
        raise FrameFormatError(f"{name}: the JPEG is cut off after {len(content)} bytes")
    if content[:2] in (b"P5", b"P6"):
        _check_pnm(content, name)
    if (order := _TIFF_MAGICS.get(content[:4])) is not None:
        # The camera is that of the pixels as they are stored; decoders turn them, and darken them by alpha.
        plain = {_ORIENTATION: 1, _EXTRA: 0}
        places = [(place, plain[tag]) for tag, _, place in _tiff_tags(content, order) if tag in plain]
        if places:
            stored = bytearray(content)
            for place, value in places:
                struct.pack_into(f"{order}H", stored, place, value)
            content = bytes(stored)
    return content


def _png_parts(content: bytes, name: str) -> Iterator[tuple[bytes, bytes]]:
    """Yield the kind of each part of a PNG, and the whole part; raises FrameFormatError at a damaged one."""
    place = len(_PNG_MAGIC)
    for _ in range(_PNG_PARTS_MAX):
        length, kind = int.from_bytes(content[place : place + 4]), content[place + 4 : place + 8]
        end = place + 12 + length
        if end > len(content):
            raise FrameFormatError(f"{name}: the PNG is cut off after {len(content)} bytes")
        if zlib.crc32(content[place + 4 : end - 4]) != int.from_bytes(content[end - 4 : end]):
            raise FrameFormatError(f"{name}: the PNG is damaged (checksum of its part {kind!r})")
        yield kind, content[place:end]
        if kind == b"IEND":
            return
        place = end
    raise FrameFormatError(f"{name}: the PNG has more than {_PNG_PARTS_MAX} parts")


def _check_pnm(content: bytes, name: str) -> None:
    width, height, maximum, start = _pnm_header(content, name)
    expected = width * height * (3 if content[1:2] == b"6" else 1) * (2 if maximum > 255 else 1)
    if len(content) - start < expected:
        raise FrameFormatError(f"{name}: the image is cut off: {len(content) - start} bytes of {expected}")


def decode(content: bytes, flags: int, name: str) -> NDArray[Any]:
    """Decode an image as OpenCV does with these flags; raises FrameFormatError, which calls it `name`."""
    checked = _checked(content, name)
    # OpenCV would also write its own report to stderr.
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(checked, np.uint8), flags)
    except cv2.error as err:
        raise FrameFormatError(f"{name}: the image cannot be decoded ({quoted(err.err)})") from err
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        hint = "8 bits" if flags != cv2.IMREAD_UNCHANGED else "16 bits or float32"
        hint = f", or of a kind of TIFF that is not read: save it without compression or tiles, as {hint}"
        hint = hint if checked[:4] in _TIFF_MAGICS else ""
        raise FrameFormatError(f"{name}: the image is damaged and cannot be decoded{hint}")
    return image


def decode_color(content: bytes, name: str) -> NDArray[np.uint8]:
    """Decode a color image to (H, W, 3) uint8 RGB; gray is spread over the three channels.

    Raises FrameFormatError, which calls the image `name`, if it is cut off, damaged or of an unknown form.
    """
    if content.startswith(NPY_MAGIC):
        return read_npy(content, name, color=True)
    if content[:2] in (b"P5", b"P6") and (most := _pnm_header(content, name)[2]) not in (255, 65535):
        # Decoders pass it over.
        raise FrameFormatError(f"{name}: maximum: expected 255 or 65535 for color, got {most}")
    bgr = decode(content, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, name)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False)


def decode_stored(content: bytes, name: str) -> NDArray[Any]:
    """Decode a depth image to (H, W) whole or floating-point numbers in the unit of the file.

    The file is an image of one channel of 16 or 32 bits, or an array of NumPy's. Raises FrameFormatError,
    which calls the image `name`, if it is cut off, damaged or of another form.
    """
    if content.startswith(NPY_MAGIC):
        return read_npy(content, name)
    image = decode(content, cv2.IMREAD_UNCHANGED, name)
    if content.startswith(_JPEG_MAGIC):
        raise FrameFormatError(
            f"{name}: a JPEG is no depth image, as it is compressed with loss; export 16-bit PNG"
        )
    bits = 8 * image.dtype.itemsize
    if image.ndim == 2 and bits > 8:
        return image
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels == 4 and bits == 8:
        # TartanAir's: the bytes of a number of meters. As such, colors are negative, or next to nothing.
        meters: NDArray[np.float32] = np.ascontiguousarray(image).view("<f4")[..., 0]
        if (meters >= 0).all() and meters.max(initial=0) > 0.01:
            return meters
    hint = ""
    if bits == 8:
        what = "8 bits are" if channels == 1 else "colors are"
        hint = f"; {what} depth as it is shown, and cannot be converted back: export 16-bit PNG"
    raise FrameFormatError(
        f"{name}: expected a depth image of 1 channel of 16 bits, got {channels} of {bits} bits{hint}"
    )


def decode_labels(content: bytes, name: str) -> NDArray[np.uint16]:
    """Decode a label image of one channel of 8 or 16 bits to (H, W) uint16; of a palette, the indices.

    Raises FrameFormatError if the image is cut off, damaged or has more than one channel.
    """
    if content.startswith(_PNG_MAGIC) and content[25:26] in (_PALETTE, _GRAY_LEVELS) and 0 < content[24] <= 8:
        # The same image, said to be gray: decoders give the palette's colors otherwise.
        # Fewer bits than 8 are spread over the gray levels.
        levels = 2 ** content[24] - 1
        image = decode(_gray(content, name), cv2.IMREAD_UNCHANGED, name)
        return np.asarray(image // np.uint8(255 // levels), dtype=np.uint16)
    image = decode(content, cv2.IMREAD_UNCHANGED, name)
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise FrameFormatError(f"{name}: expected labels of 1 channel of 8 or 16 bits, got {image.shape}")
    return image.astype(np.uint16)


def _gray(content: bytes, name: str) -> bytes:
    """Return a PNG with a palette as one of gray levels, which are its indices."""
    parts = [_PNG_MAGIC]
    for kind, part in _png_parts(content, name):
        if kind == b"IHDR":
            body = bytearray(part[4:-4])
            body[4 + 9] = 0
            parts.append(part[:4] + body + zlib.crc32(body).to_bytes(4))
        elif kind in (b"IDAT", b"IEND"):
            parts.append(part)
    return b"".join(parts)


def _pnm_header(content: bytes, name: str) -> tuple[int, int, int, int]:
    """Return the width, height, maximum and length of the header of a binary PGM or PPM."""
    header = _PNM_HEADER.match(content[:_PNM_HEADER_BYTES])
    if header is None:
        raise FrameFormatError(f"{name}: expected a binary PGM or PPM with width, height and maximum")
    width, height, maximum = map(int, header.groups())
    return width, height, maximum, header.end()


def _check_size(content: bytes, name: str) -> None:
    """Refuse an image that is of no known form, or too large to be decoded, by its header alone."""
    try:
        width, height = _size(content, name)
    except (struct.error, IndexError) as err:
        raise FrameFormatError(f"{name}: the image is cut off within its header") from err
    if width < 1 or height < 1 or width * height > PIXELS_MAX:
        raise FrameFormatError(
            f"{name}: width, height: expected 1 to {PIXELS_MAX} pixels in all, got {width} x {height}"
        )


def _size(content: bytes, name: str) -> tuple[int, int]:
    if content.startswith(_PNG_MAGIC):
        width, height = struct.unpack_from(">II", content, len(_PNG_MAGIC) + 8)
        return width, height
    if content.startswith(_JPEG_MAGIC):
        return _jpeg_size(content, name)
    if content[:2] in (b"P5", b"P6"):
        return _pnm_header(content, name)[:2]
    if content.startswith(b"BM"):
        old = struct.unpack_from("<I", content, 14)[0] == 12
        width, height = struct.unpack_from("<HH" if old else "<ii", content, 18)
        # Rows run downward where the height is negative.
        return width, abs(height)
    if content[:4] in _TIFF_MAGICS:
        return _tiff_size(content, _TIFF_MAGICS[content[:4]], name)
    known = what_it_is(content[:HEAD_BYTES], Path(name))
    expected = "PNG, JPEG, TIFF, PGM, PPM, BMP"
    raise FrameFormatError(
        f"{name}: not an image that can be decoded ({expected}){(known and f': {known}') or ''}"
    )


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
    """Return the size of the only image, or of the strip or tile that is decoded at once, if larger."""
    tags: dict[int, int] = {}
    for tag, value, _ in _tiff_tags(content, order):
        tags[tag] = max(value, tags.get(tag, 0))
    if tags.get(_SAMPLES, 1) > 4 or tags.get(_BITS, 1) > 32:
        raise FrameFormatError(f"{name}: expected a TIFF of up to 4 channels of up to 32 bits")
    if tags.get(_COLORS, 1) not in _TIFF_COLORS:
        raise FrameFormatError(
            f"{name}: PhotometricInterpretation: expected gray or RGB, got {tags[_COLORS]}"
        )
    after = tags[_AFTER] and {tag: value for tag, value, _ in _tiff_tags(content, order, tags[_AFTER])}
    if tags.get(_REDUCED, 0) & 1 or (after and not after.get(_REDUCED, 0) & 0b101):  # smaller, a mask
        raise FrameFormatError(f"{name}: the TIFF has several images; save each by itself")
    width, height = tags.get(_WIDTH, 0), tags.get(_HEIGHT, 0)
    rows = tags.get(_STRIP_ROWS, 0)
    # All ones: the whole image in one strip.
    decoded = [(width, height), (width, 0 if rows == 0xFFFFFFFF else rows)]
    decoded.append((tags.get(_TILE_WIDTH, 0), tags.get(_TILE_HEIGHT, 0)))
    return max(decoded, key=lambda size: size[0] * size[1])


def _tiff_tags(content: bytes, order: str, place: int = 0) -> Iterator[tuple[int, int, int]]:
    """Yield the tags of an image, or the first, that are whole numbers, the first of each and where it is."""
    place = place or struct.unpack_from(f"{order}I", content, 4)[0]
    count = struct.unpack_from(f"{order}H", content, place)[0]
    yield _AFTER, struct.unpack_from(f"{order}I", content, place + 2 + 12 * count)[0], place + 2 + 12 * count
    for number in range(count):
        tag, kind, values = struct.unpack_from(f"{order}HHI", content, place + 2 + 12 * number)
        code = _TIFF_TYPES.get(kind)
        if code is None or not values:
            continue
        at = place + 10 + 12 * number
        if values * struct.calcsize(code) > 4:
            at = struct.unpack_from(f"{order}I", content, at)[0]
        yield tag, struct.unpack_from(f"{order}{code}", content, at)[0], at


NPY_MAGIC = b"\x93NUMPY"
_HEADER_MAX = 4096
#: Others are of arrays with named fields.
_NPY_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def read_npy(content: bytes, name: str, *, color: bool = False) -> NDArray[Any]:
    """Return the numbers of an array that NumPy saved, without running what may be in it.

    They are (H, W) depth of more than one byte, dimensions of length 1 being dropped, or (H, W, 3) `color` of
    one byte. Raises FrameFormatError, which calls the array `name`, if it is damaged, too large or of another
    form.
    """
    stream = io.BytesIO(content[: 2 * _HEADER_MAX])
    try:
        read_header = _NPY_HEADERS[npy.read_magic(stream)]
        shape, by_columns, dtype = read_header(stream, max_header_size=_HEADER_MAX)
    except (ValueError, SyntaxError, TypeError, KeyError, RecursionError, MemoryError) as err:
        raise FrameFormatError(
            f"{name}: the NumPy array's header cannot be read ({quoted(str(err))})"
        ) from err
    if dtype != np.uint8 if color else dtype.kind not in "iuf" or dtype.itemsize < 2:
        expected = "color of 8 bits, RGB" if color else "depth of 16 bits or floating point"
        raise FrameFormatError(f"{name}: expected {expected}, got an array of {dtype}")
    if not all(isinstance(each, int) and each > 0 for each in shape):
        raise FrameFormatError(f"{name}: expected a shape of whole numbers over 0, got {quoted(shape)}")
    size = shape if color else tuple(each for each in shape if each > 1)
    is_image = len(size) == 3 and size[2] == 3 if color else len(size) == 2
    is_image = is_image and math.prod(size[:2]) <= PIXELS_MAX
    if not is_image or math.prod(size) * dtype.itemsize > FRAME_BYTES_MAX:
        raise FrameFormatError(
            f"{name}: expected one image of {PIXELS_MAX} pixels at most{', (H, W, 3)' if color else ''}, got "
            f"an array of {quoted(shape)}"
        )
    if len(content) - stream.tell() < math.prod(size) * dtype.itemsize:
        raise FrameFormatError(f"{name}: the NumPy array is cut off after {len(content)} bytes")
    values = np.frombuffer(content, dtype, math.prod(size), stream.tell())
    array = values.reshape(size, order="F" if by_columns else "C")
    # Of 16 bits, floating-point numbers end at 65504.
    kept = np.dtype(np.float32) if dtype.kind == "f" and dtype.itemsize == 2 else dtype.newbyteorder("=")
    return np.ascontiguousarray(array.astype(kept, copy=False))
