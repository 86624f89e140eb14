"""A program that reads a camera and sends its frames to another process.

The other process computes, and Python lets only one of its threads run at a time: a thread that reads a
camera there would often be late, and OpenNI2 keeps only the newest image. Here nothing else runs, and a
driver that crashes or hangs stops only this process.
"""

import contextlib
import logging
import os
import sys
import time
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from typing import Any, NoReturn

from nurbseg.common.errors import DeviceNotFoundError, FrameFormatError, FrameTimeoutError
from nurbseg.common.frame import Calibration
from nurbseg.common.process.channel import Channel, LogForwarder, connect_to_parent
from nurbseg.common.process.codec import Call
from nurbseg.drivers.live.isolated.source import CODEC, DRIVERS, CameraFrame, DamagedImage
from nurbseg.drivers.options import DeviceOptions
from nurbseg.drivers.source import FrameSource

#: Longest wait for a frame before messages are looked at again, seconds.
_SLICE_S = 0.1
#: Pause after a damaged image, seconds.
_DAMAGED_S = 2e-3
#: What ending may take, seconds.
_END_S = 30.0


def open_camera(
    channel: Channel,
    log_level: int,
    wanted: str,
    options: DeviceOptions,
    pairing_limit_s: float,
    patience_s: float | None,
    driver: str,
) -> Iterator[tuple[dict[str, str], Calibration]]:
    """Open a camera, yield its metadata and calibration, and deliver its frames until it is lost.

    Where it is not there, look for it every `patience_s` seconds, if that is given.
    """
    logging.basicConfig(level=log_level, handlers=[LogForwarder(channel)])
    module, _, name = DRIVERS[driver][1].partition(":")
    open_source = getattr(import_module(f"nurbseg.drivers.{module}"), name)
    source: FrameSource | None = None
    while source is None:
        try:
            source = open_source(wanted, options, pairing_limit_s=pairing_limit_s)
        except DeviceNotFoundError:
            if patience_s is None:
                raise
            channel.beat()
            next_s = time.monotonic() + patience_s
            while (left_s := next_s - time.monotonic()) > 0:
                channel.receive(left_s)
    with source:
        yield source.metadata, source.calibration
        _deliver(source, channel)


def _deliver(source: Any, channel: Channel) -> NoReturn:
    """Send frames from the call of "begin" on."""
    begun = False
    while True:
        while channel.is_waiting():
            begun |= isinstance(channel.receive(0.0), Call)
        channel.beat()
        try:
            frame = source.read(_SLICE_S)
        except FrameTimeoutError:
            continue
        except FrameFormatError as err:
            if begun:
                channel.send(DamagedImage(str(err)), 0.0)
            # No camera delivers this many; a driver that has gone wrong may.
            time.sleep(_DAMAGED_S)
            continue
        if not begun:
            # Nobody reads yet: these frames are not missed.
            source.missed = source.half_pairs = 0
            continue
        message = CameraFrame(
            frame.timestamp_ns,
            frame.depth_mm,
            frame.color,
            source.missed,
            source.half_pairs,
            frame.gravity,
        )
        source.missed += not channel.send(message, 0.0)


def main() -> int:
    """Open the camera that is asked for, and deliver its frames."""
    channel = connect_to_parent(CODEC, limit_s=_END_S)
    with contextlib.suppress(OSError):  # only some users may; a frame is lost if this is 33 ms late
        os.nice(-10)
    channel.serve({open_camera.__name__: partial(open_camera, channel)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
