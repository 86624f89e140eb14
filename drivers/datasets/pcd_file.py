"""Reads organized point clouds from PCD files, ascii, binary or compressed."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError, quoted
from nurbseg.common.files import read_file
from nurbseg.common.limits import FRAME_BYTES_MAX, PIXELS_MAX

_HEADER_BYTES_MAX = 65_536
_FIELDS_MAX = 256
_COUNT_MAX = 4096
#: TYPE and SIZE.
_NUMBERS = frozenset(("F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8"))


@dataclass(frozen=True, slots=True, eq=False)
class OrganizedCloud:
    """What an organized PCD file holds.

    `points_m` (H, W, 3) are in meters in the camera's frame, NaN where there is no point; `color` (H, W, 3)
    is RGB, where the file has color.
    """

    points_m: NDArray[np.float32]
    color: NDArray[np.uint8] | None


def read_pcd(path: Path) -> OrganizedCloud:
    """Read an organized cloud.

    Raises FrameFormatError if the file is damaged or the cloud has no rows and columns; names the field.
    """
    content = read_file(path, FRAME_BYTES_MAX, what="cloud", error=FrameFormatError)
    fields, start = _header(path, content)
    width, height = (_positive(path, fields, name) for name in ("WIDTH", "HEIGHT"))
    points = _positive(path, fields, "POINTS") if "POINTS" in fields else width * height
    if height < 2 or width < 2:
        raise FrameFormatError(
            f"{path}: HEIGHT: the cloud is not organized ({width}x{height}); expected the rows and columns "
            "of a depth image"
        )
    if points != width * height:
        raise FrameFormatError(f"{path}: POINTS: expected WIDTH x HEIGHT = {width * height}, got {points}")
    if points > PIXELS_MAX:
        raise FrameFormatError(f"{path}: WIDTH, HEIGHT: expected {PIXELS_MAX} points at most, got {points}")
    layout = _layout(path, fields)
    kind = " ".join(fields["DATA"])
    # Numbers of text become 8 bytes each.
    numbers = sum(layout[name].shape[0] for name in layout.names or ())
    point_bytes = 8 * numbers if kind == "ascii" else layout.itemsize
    if points * point_bytes > FRAME_BYTES_MAX:
        raise FrameFormatError(
            f"{path}: POINTS, SIZE, COUNT: expected {FRAME_BYTES_MAX} bytes at most, "
            f"got {points} points of {point_bytes}"
        )
    readers = {"ascii": _from_ascii, "binary": _from_binary, "binary_compressed": _from_compressed}
    if kind not in readers:
        raise FrameFormatError(
            f"{path}: DATA: expected ascii, binary or binary_compressed, got {quoted(kind)}"
        )
    values = readers[kind](path, memoryview(content)[start:], layout, points)
    xyz = np.empty((points, 3), np.float32)
    for place, name in enumerate(("x", "y", "z")):
        xyz[:, place] = values[name]
    xyz[~np.isfinite(xyz).all(axis=-1)] = np.nan
    color = rgb_of({name: values[name] for name in COLORS if name in values})
    shape = (height, width, 3)
    return OrganizedCloud(xyz.reshape(shape), None if color is None else color.reshape(shape))


def _header(path: Path, content: bytes) -> tuple[dict[str, list[str]], int]:
    end = re.search(rb"^DATA[ \t]+\w+[ \t]*\r?\n", content[:_HEADER_BYTES_MAX], re.MULTILINE)
    if end is None:
        raise FrameFormatError(f"{path}: DATA: the header of a PCD file is missing or cut off")
    fields = {}
    for line in content[: end.end()].decode(errors="replace").splitlines():
        words = line.partition("#")[0].split()
        if words:
            fields[words[0].upper()] = words[1:]
    for name in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT"):
        if name not in fields:
            raise FrameFormatError(f"{path}: {name}: missing in the header")
    return fields, end.end()


def _positive(path: Path, fields: dict[str, list[str]], name: str) -> int:
    words = fields[name]
    number = _whole(words[0]) if len(words) == 1 else 0
    if not 1 <= number <= PIXELS_MAX:
        raise FrameFormatError(f"{path}: {name}: expected 1 to {PIXELS_MAX}, got {quoted(' '.join(words))}")
    return number


def _whole(word: str) -> int:
    """Return the number that a word says, 0 where it is none of up to nine digits."""
    return int(word) if re.fullmatch(r"[0-9]{1,9}", word) else 0


def _layout(path: Path, fields: dict[str, list[str]]) -> np.dtype[np.void]:
    """Return how a point is stored: each field under its name, and as often as it says.

    A name that is there several times, as padding is, is replaced by one that no field can have.
    """
    names, sizes, types = fields["FIELDS"], fields["SIZE"], fields["TYPE"]
    counts = fields.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(types) == len(counts):
        raise FrameFormatError(f"{path}: FIELDS, SIZE, TYPE, COUNT: expected as many of each")
    if len(names) > _FIELDS_MAX:
        raise FrameFormatError(f"{path}: FIELDS: expected {_FIELDS_MAX} at most, got {len(names)}")
    missing = [name for name in ("x", "y", "z") if name not in names]
    if missing:
        raise FrameFormatError(f"{path}: FIELDS: {', '.join(missing)} missing; got {quoted(names)}")
    columns: list[tuple[str, str, tuple[int]]] = []
    for name, width, kind, count in zip(names, sizes, types, counts, strict=True):
        if kind + width not in _NUMBERS:
            number = quoted(f"{name}: unknown number {kind} of {width} bytes")[1:-1]
            raise FrameFormatError(f"{path}: TYPE, SIZE: {number}")
        if not 1 <= _whole(count) <= _COUNT_MAX:
            raise FrameFormatError(
                f"{path}: COUNT: {quoted(name)}: expected 1 to {_COUNT_MAX}, got {quoted(count)}"
            )
        once = names.count(name) == 1
        if name in ("x", "y", "z") and (int(count) != 1 or not once):
            raise FrameFormatError(f"{path}: FIELDS: {name}: expected once with COUNT 1")
        key = name if once else f"{name} {len(columns)}"
        columns.append((key, f"<{kind.lower()}{width}", (int(count),)))
    return np.dtype(columns)


#: The first number of each field of every point, by name.
Values = dict[str, NDArray[Any]]


def _from_binary(path: Path, body: memoryview, layout: np.dtype[np.void], points: int) -> Values:
    size = points * layout.itemsize
    if len(body) < size:
        raise FrameFormatError(f"{path}: DATA: the file is cut off: {len(body)} bytes of {size}")
    table = np.frombuffer(body, layout, points)
    return {name: table[name][:, 0] for name in layout.names or ()}


def _from_compressed(path: Path, body: memoryview, layout: np.dtype[np.void], points: int) -> Values:
    compressed, uncompressed = int.from_bytes(body[:4], "little"), int.from_bytes(body[4:8], "little")
    expected = points * layout.itemsize
    if len(body) < 8 + compressed or uncompressed != expected:
        raise FrameFormatError(
            f"{path}: DATA: the file is cut off or damaged: {len(body) - 8} bytes of {compressed}, "
            f"for {uncompressed} of {expected}"
        )
    try:
        content = decompress_lzf(body[8 : 8 + compressed], uncompressed)
    except ValueError as err:
        raise FrameFormatError(f"{path}: DATA: cannot be decompressed ({err})") from err
    # One field of all points after the other.
    return {
        name: np.frombuffer(content, kind, points, points * before)[:, 0]
        for name, (kind, before, *_) in (layout.fields or {}).items()
    }


def _from_ascii(path: Path, body: memoryview, layout: np.dtype[np.void], points: int) -> Values:
    ends = np.cumsum([layout[name].shape[0] for name in layout.names or ()])
    expected = points * int(ends[-1])
    words = bytes(body).split(None, expected)
    if len(words) != expected:
        got = "more" if len(words) > expected else f"{len(words)} numbers"
        raise FrameFormatError(f"{path}: DATA: expected {points} points of {ends[-1]} numbers, got {got}")
    try:
        table = np.fromiter(map(float, words), np.float64, expected).reshape(points, -1)
    except ValueError as err:
        raise FrameFormatError(f"{path}: DATA: not a number ({quoted(str(err))})") from err
    with np.errstate(invalid="ignore", over="ignore"):
        return {
            name: table[:, end - layout[name].shape[0]].astype(layout[name].base)
            for name, end in zip(layout.names or (), ends, strict=True)
        }


def decompress_lzf(content: bytes | memoryview, size: int) -> bytes:
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


#: Names of fields that have color.
COLORS = ("rgb", "rgba", "r", "g", "b")


def rgb_of(fields: Values) -> NDArray[np.uint8] | None:
    """Return the RGB, in a last axis, of the `COLORS` that a cloud has; None if they are none.

    They are numbers 0x00RRGGBB, which some files keep as the bits of a float, or one byte each.
    """
    packed = fields.get("rgb", fields.get("rgba"))
    if packed is None:
        own = [fields[name] for name in "rgb" if name in fields and fields[name].dtype == np.uint8]
        return np.stack(own, axis=-1) if len(own) == 3 else None
    if packed.dtype.itemsize != 4:
        with np.errstate(invalid="ignore", over="ignore"):
            packed = packed.astype(np.float32 if packed.dtype.kind == "f" else np.uint32)
    bits = np.ascontiguousarray(packed).view(np.uint32)
    return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=-1).astype(np.uint8)
