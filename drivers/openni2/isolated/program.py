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
from pathlib import Path
from typing import Any, NoReturn

from nurbseg.drivers.errors import DeviceNotFoundError, DriverError, FrameTimeoutError
from nurbseg.drivers.openni2.device import DeviceSource
from nurbseg.drivers.openni2.isolated import messages
from nurbseg.drivers.process.channel import Channel, ChannelClosedError, LogForwarder, connect_to_parent

#: Longest wait for a frame before messages are looked at again, seconds.
_SLICE_S = 0.1
#: Longest wait at a time for what is to be opened, and what ending may take, with a recording to be
#: finished; seconds.
_BEGIN_S, _END_S = 60.0, 30.0


def _open(request: messages.Open, channel: Channel) -> DeviceSource:
    """Open the camera, waiting for it if that is asked."""
    while True:
        try:
            return DeviceSource(request.wanted, request.options, pairing_limit_s=request.pairing_limit_s)
        except DeviceNotFoundError:
            if request.patience_s is None:
                raise
        channel.beat()
        next_s = time.monotonic() + request.patience_s
        while (left_s := next_s - time.monotonic()) > 0:
            channel.receive(left_s)


def _deliver(source: DeviceSource, channel: Channel) -> NoReturn:
    begun = False
    lost, before = 0, (0, 0)
    while True:
        for message in _messages(channel):
            if isinstance(message, messages.Begin):
                begun = True
            else:
                channel.send(_handled(source, message))
        channel.beat()
        try:
            frame = source.read(_SLICE_S)
        except FrameTimeoutError:
            continue
        if not begun:
            # Nobody reads yet: these frames are not missed.
            before = source.missed, source.half_pairs
            continue
        message = messages.CameraFrame(
            frame.timestamp_ns,
            frame.depth_mm,
            frame.color,
            missed=source.missed - before[0] + lost,
            half_pairs=source.half_pairs - before[1],
        )
        lost += not channel.send(message, 0.0)


def _messages(channel: Channel) -> Iterator[Any]:
    """Yield the messages that have arrived since the last call."""
    while channel.is_waiting():
        if (message := channel.receive(0.0)) is not None:
            yield message


def _handled(source: DeviceSource, message: Any) -> messages.Done | messages.Failure:
    try:
        if isinstance(message, messages.Record):
            source.start_recording(Path(message.path), lossy=message.lossy)
        else:
            source.stop_recording()
    except DriverError as err:
        return messages.Failure.of(err)
    return messages.Done()


def main() -> int:
    """Open the camera that the first message describes, and deliver its frames."""
    channel = connect_to_parent(messages.CODEC, limit_s=_END_S)
    with contextlib.suppress(OSError):  # only some users may; a frame is lost if this is 33 ms late
        os.nice(-10)
    try:
        while (request := channel.receive(_BEGIN_S)) is None:
            pass  # Started in advance, for when a camera is plugged in again.
        if not isinstance(request, messages.Open):
            return 1
        logging.basicConfig(level=request.log_level, handlers=[LogForwarder(channel)])
        with _open(request, channel) as source:
            channel.send(messages.Opened(dict(source.metadata), source.calibration))
            _deliver(source, channel)
    except ChannelClosedError:
        return 0
    except DriverError as err:
        with contextlib.suppress(ChannelClosedError):
            channel.send(messages.Failure.of(err, fatal=True))
        return 1


if __name__ == "__main__":
    sys.exit(main())
