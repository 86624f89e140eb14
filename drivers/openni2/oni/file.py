"""The structure of an .oni file: its streams, and which frames it holds. Pixels are left to OpenNI2.

A file is a header and a chain of records, each with a small header of its own. Reading the chain shows
without decoding how many frames there are and when they were taken, which OpenNI2 itself does not report
of a recording that was cut short, and keeps most damaged files away from its driver.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from nurbseg.common.errors import RecordingFormatError
from nurbseg.common.files import ONI_MAGIC
from nurbseg.drivers.openni2.capi import BYTES_PER_PIXEL, Sensor

_HEADER = struct.Struct("<4sBBHIQI")  # magic, version, largest time, largest node number
_RECORD = struct.Struct("<IIIIIQ")  # magic, type, node, size with fields, size of payload, undo position
_MAGIC = 0x0052494E  # "NIR"
_NODE_ADDED = (0x02, 0x0C, 0x0D)
_INT_PROPERTY, _GENERAL_PROPERTY = 0x03, 0x06
_NEW_DATA, _END = 0x0A, 0x0B
_LARGEST_FIELDS = 1 << 20
_LARGEST_SIDE = 4096
#: The numbers of node types, in the file's own count.
_SENSORS = {2: Sensor.DEPTH, 3: Sensor.COLOR, 5: Sensor.IR}
_UNCOMPRESSED = b"NONE"


class StoredFrame(NamedTuple):
    """A frame's number in its stream, and its time in microseconds from the stream's first frame."""

    number: int
    timestamp_us: int


@dataclass(slots=True)
class StoredStream:
    """One stream of a recording.

    The `codec` of its pixels has four letters; the `size` is (0, 0) until the record of the mode is read.
    """

    sensor: Sensor
    codec: bytes
    size: tuple[int, int] = (0, 0)
    fps: int = 30
    pixel_format: int = 0
    frames: list[StoredFrame] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class OniFile:
    """What a recording holds.

    It is `complete` if the recorder got to write its end; otherwise the frames are those before the break.
    """

    path: Path
    depth: StoredStream
    color: StoredStream
    complete: bool


def read_structure(path: Path) -> OniFile:
    """Read which streams and frames a recording holds.

    Raises RecordingFormatError if it is no .oni file, lacks a stream or any frames, or holds a record that
    contradicts itself.
    """
    try:
        with path.open("rb") as file:
            return _read(path, file)
    except OSError as err:
        raise RecordingFormatError(f"{path}: cannot be read ({err.strerror})") from err
    except ValueError as err:
        raise RecordingFormatError(f"{path}: {err}") from err


def _read(path: Path, file: BinaryIO) -> OniFile:
    head = file.read(_HEADER.size)
    if len(head) < _HEADER.size or not head.startswith(ONI_MAGIC):
        raise ValueError("header: not an OpenNI recording (.oni)")
    streams: dict[int, StoredStream] = {}
    complete = False
    *_, counted = _HEADER.unpack(head)
    for kind, node, fields, payload_size in _records(file):
        if kind == _END:
            complete = True
            break
        if kind in _NODE_ADDED:
            _add_stream(streams, node, fields)
        elif node in streams and kind in (_INT_PROPERTY, _GENERAL_PROPERTY):
            _take_property(streams[node], fields)
        elif node in streams and kind == _NEW_DATA:
            _add_frame(streams[node], fields, payload_size)
    if counted < max(streams, default=0):
        raise ValueError(
            "header: counts one stream too few, as OpenNI2's recorder does until it is closed, so that its "
            "player refuses the file"
        )
    found = {stream.sensor: stream for stream in streams.values() if stream.frames}
    for sensor in (Sensor.DEPTH, Sensor.COLOR):
        if sensor not in found:
            cut = "" if complete else " before it breaks off"
            raise ValueError(f"{sensor.name.lower()}: the recording holds no frames{cut}")
    return OniFile(path, found[Sensor.DEPTH], found[Sensor.COLOR], complete)


def _records(file: BinaryIO) -> Iterator[tuple[int, int, bytes, int]]:
    """Yield type, node, fields and payload size of each whole record."""
    position, size = _HEADER.size, file.seek(0, 2)
    while position + _RECORD.size <= size:
        file.seek(position)
        magic, kind, node, fields_size, payload_size, _undo = _RECORD.unpack(file.read(_RECORD.size))
        end = position + fields_size + payload_size
        sound = magic == _MAGIC and _RECORD.size <= fields_size <= _LARGEST_FIELDS
        if not sound or end > size:
            return
        yield kind, node, file.read(fields_size - _RECORD.size), payload_size
        position = end


def _name(fields: bytes) -> tuple[str, bytes]:
    """Return the name at the start of a record's fields, and what follows it."""
    length = int.from_bytes(fields[:4], "little")
    if len(fields) < 4 + length or length == 0 or fields[3 + length] != 0:
        raise ValueError("a name in a record is longer than the record")
    return fields[4 : 3 + length].decode(errors="replace"), fields[4 + length :]


def _add_stream(streams: dict[int, StoredStream], node: int, fields: bytes) -> None:
    name, rest = _name(fields)
    if len(rest) < 8:
        raise ValueError(f"{name}: the stream's record is too short")
    kind = int.from_bytes(rest[:4], "little")
    if kind in _SENSORS and node not in streams:
        streams[node] = StoredStream(_SENSORS[kind], rest[4:8])


def _take_property(stream: StoredStream, fields: bytes) -> None:
    name, rest = _name(fields)
    value = rest[4:]
    if int.from_bytes(rest[:4], "little") != len(value):
        raise ValueError(f"{name}: its size contradicts the record's")
    if name == "xnMapOutputMode" and len(value) == 12:
        width, height, fps = struct.unpack("<III", value)
        if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
            raise ValueError(f"xnMapOutputMode: {width}x{height} is no image size")
        stream.size, stream.fps = (width, height), max(fps, 1)
    elif name == "oniPixelFormat" and len(value) == 8:
        stream.pixel_format = int.from_bytes(value, "little")


def _add_frame(stream: StoredStream, fields: bytes, payload_size: int) -> None:
    sensor = stream.sensor.name.lower()
    if len(fields) < 12:
        raise ValueError(f"{sensor}: a frame's record is too short")
    timestamp_us, number = struct.unpack_from("<QI", fields)
    width, height = stream.size
    if width == 0:
        raise ValueError("xnMapOutputMode: missing before the first frame")
    # The format is a number that may be none of `PixelFormat`, which are whole numbers too.
    expected = width * height * BYTES_PER_PIXEL.get(stream.pixel_format, 0)  # type: ignore[call-overload]
    name = f"{sensor} frame {number}"
    if stream.codec == _UNCOMPRESSED and expected and payload_size != expected:
        raise ValueError(f"{name}: {payload_size} bytes, {expected} expected of {width}x{height}")
    if stream.frames and number <= stream.frames[-1].number:
        raise ValueError(f"{name}: comes after frame {stream.frames[-1].number}")
    stream.frames.append(StoredFrame(number, timestamp_us))
