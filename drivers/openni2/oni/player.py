"""Plays an .oni file with OpenNI2's file driver, image by image.

This runs as a program of its own, because a damaged file may crash the driver or make it hang;
`PlayerProcess` starts it, and bounds every wait for it.
"""

import contextlib
import ctypes
import sys
from collections.abc import Iterator

from nurbseg.common.errors import DriverError
from nurbseg.common.process.channel import ChannelClosedError, connect_to_parent
from nurbseg.drivers.openni2.capi import DeviceProperty, DeviceState, Sensor, StreamProperty
from nurbseg.drivers.openni2.oni.played import (
    OPEN_LIMIT_S,
    Description,
    Played,
    PlayedImage,
    StreamDescription,
)
from nurbseg.drivers.openni2.opened import OpenedDevice
from nurbseg.drivers.openni2.stream import Stream, wait_for_any

#: Step by step: the driver advances to the next image only when one is waited for, so none is lost.
_STEPWISE = -1.0
#: Must be longer than any image takes: a second trigger on its way would overwrite an image.
_WAIT_S = 5.0
#: Longest wait for this process to end, seconds.
_END_S = 2.0
#: Images that may wait, and the largest, bytes.
_SLOTS, _IMAGE_BYTES = 4, 1 << 26


def _description(stream: Stream) -> StreamDescription:
    mode = stream.mode
    return StreamDescription(
        (mode.width, mode.height),
        mode.pixel_format,
        stream.find(StreamProperty.HORIZONTAL_FOV, ctypes.c_float),
        bool(stream.find(StreamProperty.MIRRORING, ctypes.c_int)),
    )


def play(path: str) -> Iterator[Description | PlayedImage | Played]:
    """Yield a description, every image in the order of the file, and the end.

    Raises DriverError if OpenNI2 cannot play it.
    """
    with OpenedDevice(path) as device:
        device.set(DeviceProperty.PLAYBACK_REPEAT_ENABLED, ctypes.c_int(0))
        device.set(DeviceProperty.PLAYBACK_SPEED, ctypes.c_float(_STEPWISE))
        streams = device.add_stream(Sensor.DEPTH), device.add_stream(Sensor.COLOR)
        depth, color = map(_description, streams)
        yield Description(device.library.version(), depth, color)
        for stream in streams:
            stream.start()
        while ready := wait_for_any(
            device.library, streams, 0.2 if DeviceState.EOF in device.states else _WAIT_S
        ):
            if (image := ready.take()) is not None:
                yield PlayedImage(ready.sensor, image.number, image.pixels)
        # Before the driver is closed, which crashes it now and then.
        yield Played()


def main() -> int:
    """Play the file that is asked for."""
    channel = connect_to_parent(limit_s=_END_S)
    with contextlib.suppress(ChannelClosedError):
        path = str(channel.receive(OPEN_LIMIT_S))
        channel.begin_ring(_SLOTS, _IMAGE_BYTES)
        try:
            for item in play(path):
                while not channel.put(item, _WAIT_S):
                    pass  # until one is taken
        except (DriverError, ValueError) as err:
            while not channel.put(Played(err), _WAIT_S):
                pass
        while True:
            channel.receive(_WAIT_S)
    return 0


if __name__ == "__main__":
    sys.exit(main())
