"""The structure of an .oni file: which frames its streams hold. Everything else is left to OpenNI2.

A file is a header and a chain of records, each with a small header of its own. Reading the chain shows
without decoding how many frames there are and when they were taken, which OpenNI2 itself does not report of
a recording that was cut short.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

from nurbseg.common.errors import RecordingFormatError
from nurbseg.common.files import ONI_MAGIC
from nurbseg.drivers.openni2.capi import Sensor

_HEADER = struct.Struct("<4sBBHIQI")  # magic, version, largest time, largest node number
_RECORD = struct.Struct("<IIIIIQ")  # magic, type, node, size with fields, size of payload, undo position
_MAGIC = 0x0052494E  # "NIR"
_NODE_ADDED = (0x02, 0x0C, 0x0D)
_NEW_DATA, _END = 0x0A, 0x0B
_LARGEST_FIELDS = 1 << 20
#: The numbers of node types, in the file's own count.
_SENSORS = {2: Sensor.DEPTH, 3: Sensor.COLOR, 5: Sensor.IR}


class StoredFrame(NamedTuple):
    """A frame's number in its stream, and its time in microseconds from the stream's first frame."""

    number: int
    timestamp_us: int


@dataclass(frozen=True, slots=True)
class PlayedStream:
    """What OpenNI2 says of depth or color in a file; the field of view is horizontal, in radians, or None."""

    width: int
    height: int
    fps: int
    pixel_format: int
    fov_rad: float | None
    mirrored: bool


class OniFile(NamedTuple):
    """The frames that a recording holds.

    It is `complete` if the recorder got to write its end; otherwise the frames are those before the break.
    """

    depth: list[StoredFrame]
    color: list[StoredFrame]
    complete: bool


def read_structure(path: Path) -> OniFile:
    """Read which frames a recording holds.

    Raises RecordingFormatError if it is no .oni file, lacks a stream or any frames, or holds a record that
    contradicts itself.
    """
    try:
        with path.open("rb") as file:
            return _read(file)
    except OSError as err:
        raise RecordingFormatError(f"{path}: cannot be read ({err.strerror})") from err
    except (ValueError, struct.error) as err:
        raise RecordingFormatError(f"{path}: {err}") from err


def _read(file: BinaryIO) -> OniFile:
    head = file.read(_HEADER.size)
    if len(head) < _HEADER.size or not head.startswith(ONI_MAGIC):
        raise ValueError("header: not an OpenNI recording (.oni)")
    *_, counted = _HEADER.unpack(head)
    sensors: dict[int, Sensor] = {}
    frames: dict[Sensor, list[StoredFrame]] = {sensor: [] for sensor in Sensor}
    complete = False
    for kind, node, fields in _records(file):
        if kind == _END:
            complete = True
            break
        if kind in _NODE_ADDED:
            # A stream's type follows its name.
            (length,) = struct.unpack_from("<I", fields)
            (number,) = struct.unpack_from("<I", fields, 4 + length)
            if number in _SENSORS:
                sensors.setdefault(node, _SENSORS[number])
        elif kind == _NEW_DATA and node in sensors:
            stored = frames[sensors[node]]
            timestamp_us, number = struct.unpack_from("<QI", fields)
            if stored and number <= stored[-1].number:
                name = sensors[node].name.lower()
                raise ValueError(f"{name} frame {number}: comes after frame {stored[-1].number}")
            stored.append(StoredFrame(number, timestamp_us))
    if counted < max(sensors, default=0):
        raise ValueError(
            "header: counts one stream too few, as OpenNI2's recorder does until it is closed, so that its "
            "player refuses the file"
        )
    for sensor in (Sensor.DEPTH, Sensor.COLOR):
        if not frames[sensor]:
            cut = "" if complete else " before it breaks off"
            raise ValueError(f"{sensor.name.lower()}: the recording holds no frames{cut}")
    return OniFile(frames[Sensor.DEPTH], frames[Sensor.COLOR], complete)


def _records(file: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
    """Yield type, node and fields of each whole record."""
    position, size = _HEADER.size, file.seek(0, 2)
    while position + _RECORD.size <= size:
        file.seek(position)
        magic, kind, node, fields_size, payload_size, _undo = _RECORD.unpack(file.read(_RECORD.size))
        position += fields_size + payload_size
        is_sound = magic == _MAGIC and _RECORD.size <= fields_size <= _LARGEST_FIELDS
        if not is_sound or position > size:
            return
        yield kind, node, file.read(fields_size - _RECORD.size)
