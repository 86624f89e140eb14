"""The program of the source process: reads a source, plays it, records it and delivers its frames.

The program that computes lets only one of its threads run at a time: one that reads there would often be
late, and OpenNI2 keeps only the newest image. Here nothing else runs, and a driver or a damaged file that
crashes, hangs or takes all memory ends only this process.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import resource
import sys
import threading
import time
from dataclasses import asdict, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from nurbseg.common.computer import leave_a_core
from nurbseg.common.errors import (
    DriverError,
    FrameFormatError,
    FrameTimeoutError,
    RecordingFormatError,
)
from nurbseg.common.frame import RGBDFrame
from nurbseg.common.process.channel import Channel, ChannelClosedError, connect_to_parent, forward_log
from nurbseg.drivers.opening import open_here
from nurbseg.drivers.options import DeviceOptions, parse_mode
from nurbseg.drivers.player import Player
from nurbseg.drivers.process.messages import Answer, Begin, Failed, Lost, Opened, Order, RecordOptions, Status
from nurbseg.drivers.process.reconnecting import Reconnecting, same_camera
from nurbseg.drivers.source import FrameSource

if TYPE_CHECKING:
    from nurbseg.drivers.process.recording import Recording

_log = logging.getLogger("nurbseg.drivers.process.program")

#: Longest wait before orders are looked at again, seconds.
_SLICE_S = 0.05
#: Orders that set an attribute of the player.
_PLAYED = ("paused", "speed", "loop")
#: Least time between two states, seconds.
_STATUS_S = 0.1
#: Pause after a damaged frame, seconds: no camera delivers as many as a driver that has gone wrong.
_DAMAGED_S = 2e-3
#: Damaged frames that are named; further ones are only counted.
_DAMAGED_NAMED_MAX = 20
#: What ending may take, seconds; and finishing a recording whose program has died.
_END_S, _ORPHANED_S = 30.0, 0.8
#: Frames that may wait for a reader of every frame: of a camera for this long, seconds, and some more; of a
#: recording so many. And if only the newest counts.
_DEPTH_S, _MORE, _OF_RECORDING, _NEWEST = 1.0, 4, 4, 3
#: Largest frame of a recording, bytes.
_FRAME_BYTES = 1 << 27


class SourceProgram:
    """Delivers the frames of a source until it is to end."""

    def __init__(self, channel: Channel, begin: Begin) -> None:
        self._channel = channel
        self._begin = begin
        self._device = begin.options.device or DeviceOptions()
        self._is_reading = self._has_ended = False
        #: Within how many seconds to end, once that is asked for.
        self._end_s: float | None = None
        self._recording: Recording | None = None
        self._recordings: list[Recording] = []
        status = Status() if begin.lost is None else begin.lost.status
        self._read, self._damaged = status.read, status.damaged
        #: Of the first frame after somebody began to read.
        self._first_index = 0
        self._damaged_frames = status.damaged_frames
        self._lost_before: dict[str, int] = {}
        self._told, self._told_s = Status(), 0.0
        self._told_metadata: dict[str, str] | None = None
        self._source = self._opened()
        reopen = partial(open_here, begin.uri, begin.options)
        self._player = Player(self._source, name=begin.uri, reopen=reopen, **asdict(begin.playback))
        self._every = not self._player.live if begin.every is None else begin.every
        self._begin_ring()
        if self._player.live:
            with contextlib.suppress(OSError):  # only some users may; a frame is lost if this is 33 ms late
                os.nice(-10)
        if begin.lost is not None and begin.lost.recording is not None:
            self._record(begin.lost.recording)
            if self._recording is None:
                _log.error("%s: the recording cannot go on there", begin.lost.recording.path)

    def _opened(self) -> FrameSource:
        begin = self._begin
        found: FrameSource | Lost
        if (lost := begin.lost) is not None:
            uri, found = same_camera(begin.uri, lost.opened.metadata), lost
        else:
            source = open_here(begin.uri, begin.options)
            if not (source.live and self._device.reconnect):
                return source
            uri, found = same_camera(begin.uri, source.metadata), source
        reopen = partial(open_here, uri, begin.options)
        return Reconnecting(found, reopen, interval_s=self._device.reconnect_interval_s)

    def _begin_ring(self) -> None:
        if not self._player.live:
            self._channel.begin_ring(_OF_RECORDING if self._every else _NEWEST, _FRAME_BYTES)
            return
        cameras = self._player.calibration.depth, self._player.calibration.color
        size = sum(camera.width * camera.height for camera in cameras)
        fps = max(parse_mode(mode)[2] for mode in (self._device.depth_mode, self._device.color_mode))
        # Three bytes a pixel of each image, and the rest of a frame.
        self._channel.begin_ring(round(fps * _DEPTH_S) + _MORE if self._every else _NEWEST, 4 * size + 2**16)

    def run(self) -> None:
        """Deliver frames until the client finishes or ends; complete what is being recorded."""
        limit_s = _ORPHANED_S
        with self._player:
            try:
                while self._end_s is None:
                    self._serve()
                    self._deliver()
                limit_s = self._end_s
            finally:
                # First: a driver may take long to close, or crash.
                for recording in self._recordings:
                    recording.close(limit_s)
                self._has_ended = True
                self._tell(at_once=True)

    def _deliver(self) -> None:
        """Read a frame and pass it on, or wait."""
        if self._has_ended or not (self._is_reading or self._player.live):
            self._serve(_SLICE_S)
            return
        # Before somebody reads, the frames of a camera are neither missed nor counted.
        source: FrameSource = self._player if self._is_reading else self._source
        try:
            frame = source.read(_SLICE_S)
            if self._is_reading:
                self._read += 1
                index = frame.index - self._first_index
                self._pass_on(replace(frame, index=index, arrived_s=time.monotonic()))
            else:
                self._first_index = frame.index + 1
        except FrameTimeoutError:
            return
        except FrameFormatError as err:
            self._pass_over(err)
        except ChannelClosedError:
            raise
        except Exception as err:
            self._has_ended = True
            self._end_recording()
            self._tell(at_once=True)
            self._channel.send(Failed(typed(err, self._begin.uri), self._player.jumps))

    def _pass_on(self, frame: RGBDFrame) -> None:
        """Record a frame and put it into the ring; of a recording, wait until there is room."""
        self._tell()
        while (recording := self._recording) is not None and not recording.put(frame, _SLICE_S):
            self._serve()
            if self._end_s is not None:
                return
        try:
            while not self._channel.put(frame, _SLICE_S, overwrite=not self._every or self._player.live):
                self._serve()
                if self._end_s is not None:
                    return
        except ValueError as err:
            self._pass_over(FrameFormatError(f"{self._begin.uri}: frame {frame.index}: {err}"))

    def _pass_over(self, err: FrameFormatError) -> None:
        if not self._is_reading:
            return
        self._damaged += 1
        if self._damaged <= _DAMAGED_NAMED_MAX:
            self._damaged_frames += (str(err),)
            further = "; further ones are only counted" if self._damaged == _DAMAGED_NAMED_MAX else ""
            _log.warning("skipped a damaged frame: %s%s", err, further)
        time.sleep(_DAMAGED_S)

    def _serve(self, timeout_s: float = 0.0) -> None:
        """Carry out orders, and say what has changed."""
        self._channel.beat()
        order = self._channel.receive(timeout_s)
        while isinstance(order, Order):
            if order.name in _PLAYED:
                setattr(self._player, order.name, order.argument)
            else:
                getattr(self, f"_{order.name}")(*([] if order.argument is None else [order.argument]))
            order = self._channel.receive(0.0)
        self._tell()

    def _tell(self, *, at_once: bool = False) -> None:
        player, now_s = self._player, time.monotonic()
        metadata = {str(name): str(value) for name, value in player.metadata.items()}
        if metadata != self._told_metadata:
            is_first, self._told_metadata = self._told_metadata is None, metadata
            opened = Opened(player.calibration, metadata, player.depth_unit, player.live, player.seekable)
            # What a file states may be large; later, a camera states its name and how it is connected.
            (self._channel.put if is_first and self._begin.lost is None else self._channel.send)(opened)
        status = Status(
            {name: lost - self._lost_before.get(name, 0) for name, lost in player.losses.items()},
            getattr(self._source, "connected", True),
            self._read,
            self._damaged,
            self._damaged_frames,
            tuple(each.state() for each in self._recordings),
        )
        # What a frame was lost for is known with the next one; the rest changes with each frame.
        at_once |= replace(status, read=0, recordings=()) != replace(self._told, read=0, recordings=())
        is_due = at_once or now_s - self._told_s >= _STATUS_S
        if is_due and status != self._told and self._channel.send(status, _END_S if self._has_ended else 0.0):
            self._told, self._told_s = status, now_s

    # The orders:

    def _read_on(self) -> None:
        self._is_reading = True
        if self._begin.lost is None:
            self._lost_before = dict(self._player.losses)

    def _step(self) -> None:
        self._player.step()

    def _seek(self, index: int) -> None:
        self._player.seek(index)
        self._has_ended = False

    def _record(self, options: RecordOptions) -> None:
        # Late: most runs record nothing.
        from nurbseg.drivers.process.recording import Recording

        error: DriverError | OSError | None = None
        try:
            begun = Recording(options, self._player, lossless=not self._player.live)
        except (DriverError, OSError) as err:
            error = err
        else:
            self._end_recording()
            self._recording = begun
            self._recordings.append(begun)
        self._channel.send(Answer(error))

    def _end_recording(self) -> None:
        recording, self._recording = self._recording, None
        if recording is not None:
            recording.finish()

    def _finish(self, limit_s: float) -> None:
        self._end_s = limit_s


def typed(err: Exception, uri: str) -> Any:
    """Return the error that a client raises."""
    if isinstance(err, MemoryError) or (isinstance(err, OSError) and err.errno == errno.ENOMEM):
        limit_mb = resource.getrlimit(resource.RLIMIT_AS)[0] // 1_000_000
        return RecordingFormatError(
            f"{uri}: reading it takes more than {limit_mb} MB of memory; where that is no fault of it, allow "
            "more: --set source_memory_mb=N"
        )
    if isinstance(err, DriverError):
        # One of ours: another package may have made its own of it, which the client does not know.
        kind = next(each for each in type(err).__mro__ if each.__module__ == DriverError.__module__)
        return kind(str(err))
    if type(err) is ValueError:
        return err
    if isinstance(err, OSError) and err.strerror:
        return OSError(err.errno, err.strerror)
    return DriverError(f"{uri}: cannot be read ({type(err).__name__}: {err})")


def main() -> int:
    """Serve the program that started this one."""
    channel = connect_to_parent(limit_s=_END_S)
    with contextlib.suppress(ChannelClosedError):
        while not isinstance(begin := channel.receive(_SLICE_S), Begin):
            channel.beat()  # until the client has imported what it needs
        leave_a_core([threading.current_thread()])
        forward_log(channel, begin.log_level)
        limit = begin.options.memory_mb * 1_000_000
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        try:
            SourceProgram(channel, begin).run()
        except ChannelClosedError:
            raise
        except Exception as err:
            _log.debug("cannot be read", exc_info=True)
            channel.send(Failed(typed(err, begin.uri)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
