"""Plays an .oni file with OpenNI2's file driver and hands each image to another process.

This runs as a program of its own, because a damaged file may crash the driver or make it hang. It writes
messages to standard output, each a header and a body; `nurbseg.drivers.openni2.oni.playback` reads them.
"""

from __future__ import annotations

import ctypes
import json
import os
import struct
import sys
from typing import Any, BinaryIO

from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.openni2.capi import DeviceProperty, DeviceState, Sensor, StreamProperty
from nurbseg.drivers.openni2.opened import OpenedDevice
from nurbseg.drivers.openni2.stream import Stream, wait_for_any

#: Kind of message, image number, time in microseconds, height, width, channels, bytes that follow.
MESSAGE = struct.Struct("<IIQIIIQ")
DESCRIPTION, DEPTH_IMAGE, COLOR_IMAGE, FAILURE, END = range(5)

#: By hand: the driver goes on to the next image only when somebody waits for one, so none is lost.
_BY_HAND = -1.0
#: Must be longer than any image takes: a second trigger on its way would overwrite an image.
_WAIT_S = 5.0


def _send(out: BinaryIO, kind: int, body: Any, number: int = 0, timestamp_us: int = 0) -> None:
    shape = (*getattr(body, "shape", (0, 0)), 1)[:3]
    payload = memoryview(body).cast("B")
    out.write(MESSAGE.pack(kind, number, timestamp_us, *shape, len(payload)))
    out.write(payload)
    out.flush()


def _describe(device: OpenedDevice) -> dict[str, Any]:
    told: dict[str, Any] = {"openni2_version": device.library.version()}
    for stream in device.streams:
        mode = stream.mode
        told[stream.sensor.name.lower()] = {
            "size": (mode.width, mode.height),
            "fps": mode.fps,
            "format": mode.pixel_format,
            "fov": stream.find(StreamProperty.HORIZONTAL_FOV, ctypes.c_float),
            "mirrored": bool(stream.find(StreamProperty.MIRRORING, ctypes.c_int)),
        }
    return told


def play(path: str, out: BinaryIO) -> None:
    """Send a description, every image in the order of the file, and the end.

    Raises
    ------
    DriverError
        If OpenNI2 cannot play it.
    """
    ended: list[bool] = []

    def on_event(event: str) -> None:
        if event == f"state {DeviceState.EOF.value}":
            ended.append(True)

    with OpenedDevice(path, on_event) as device:
        device.try_to_set(DeviceProperty.PLAYBACK_REPEAT_ENABLED, ctypes.c_int(0))
        device.try_to_set(DeviceProperty.PLAYBACK_SPEED, ctypes.c_float(_BY_HAND))
        streams: tuple[Stream, ...] = (
            device.add_stream(Sensor.DEPTH),
            device.add_stream(Sensor.COLOR),
        )
        _send(out, DESCRIPTION, json.dumps(_describe(device)).encode())
        for stream in streams:
            stream.start()
        while True:
            ready = wait_for_any(device.library, streams, 0.2 if ended else _WAIT_S)
            if ready is None:
                break
            image = ready.take()
            if image is not None:
                kind = DEPTH_IMAGE if ready.sensor == Sensor.DEPTH else COLOR_IMAGE
                pixels = image.pixels if image.pixels.flags.c_contiguous else image.pixels.copy()
                _send(out, kind, pixels, image.number, image.timestamp_us)
        _send(out, END, b"")


def main() -> int:
    """Play the file named by the only argument to standard output."""
    # The library may print: only messages go to where standard output went.
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)
        try:
            play(sys.argv[1], out)
        except BrokenPipeError:
            # Nobody reads any more, and flushing on the way out would say so again.
            os._exit(0)
        except DriverError as err:
            _send(out, FAILURE, f"{type(err).__name__}: {err}".encode())
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
