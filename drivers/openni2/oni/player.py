"""Plays an .oni file with OpenNI2's file driver, image by image.

This runs as a program of its own, because a damaged file may crash the driver or make it hang, closing it
crashes it now and then, and going back takes a new one. `OniSource` starts it, and bounds every wait for it.
"""

import contextlib
import ctypes
import sys
from collections.abc import Iterator
from typing import Any

from nurbseg.common.errors import DriverError
from nurbseg.common.process.channel import ChannelClosedError, connect_to_parent
from nurbseg.drivers.openni2.capi import DeviceProperty, DeviceState, Sensor, StreamProperty
from nurbseg.drivers.openni2.oni.file import PlayedStream
from nurbseg.drivers.openni2.opened import OpenedDevice
from nurbseg.drivers.openni2.stream import wait_for_any

#: Step by step: the driver advances to the next image only when one is waited for, so none is lost.
_STEPWISE = -1.0
#: Must be longer than any image takes: a second trigger on its way would overwrite an image.
_WAIT_S = 5.0
#: Longest waits for the file's name, and for this process to end, seconds.
_BEGIN_S, _END_S = 30.0, 2.0
#: Images that may wait, and the largest, bytes.
_SLOTS, _IMAGE_BYTES = 4, 1 << 26


def play(path: str) -> Iterator[Any]:
    """Yield what `OniSource` reads: a description, every image in the order of the file, and None.

    The description is OpenNI2's version, and depth and color, a `PlayedStream` each; an image is a sensor, a
    number and pixels. Raises DriverError if OpenNI2 cannot play the file.
    """
    with OpenedDevice(path) as device:
        device.set(DeviceProperty.PLAYBACK_REPEAT_ENABLED, ctypes.c_int(0))
        device.set(DeviceProperty.PLAYBACK_SPEED, ctypes.c_float(_STEPWISE))
        streams = device.add_stream(Sensor.DEPTH), device.add_stream(Sensor.COLOR)
        mirrored = [bool(each.find(StreamProperty.MIRRORING, ctypes.c_int)) for each in streams]
        depth, color = (
            PlayedStream(*each.mode, each.horizontal_fov, flip)
            for each, flip in zip(streams, mirrored, strict=True)
        )
        yield device.library.version(), depth, color
        for stream in streams:
            stream.start()
        while ready := wait_for_any(
            device.library, streams, 0.2 if DeviceState.EOF in device.states else _WAIT_S
        ):
            if (image := ready.take()) is not None:
                yield ready.sensor, image.number, image.pixels
        # Before the driver is closed, which crashes it now and then.
        yield None


def main() -> int:
    """Play the file whose name is sent."""
    channel = connect_to_parent(limit_s=_END_S)
    with contextlib.suppress(ChannelClosedError):
        path = str(channel.receive(_BEGIN_S))
        channel.begin_ring(_SLOTS, _IMAGE_BYTES)

        def put(item: Any) -> None:
            while not channel.put(item, _WAIT_S):
                pass  # until one is taken

        try:
            for item in play(path):
                put((item,))
        except (DriverError, ValueError) as err:
            put(err)
        while True:
            channel.receive(_WAIT_S)
    return 0


if __name__ == "__main__":
    sys.exit(main())
