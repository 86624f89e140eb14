"""A source that is read, played and recorded by a process of its own."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import (
    DeviceLostError,
    DriverError,
    EndOfRecordingError,
    FrameTimeoutError,
    RecordingFormatError,
)
from nurbseg.common.files import part_after
from nurbseg.common.frame import RGBDFrame
from nurbseg.common.process.channel import ChannelClosedError, Items
from nurbseg.common.process.child import ChildProcess
from nurbseg.drivers.opening import CAMERAS
from nurbseg.drivers.options import DeviceOptions, SourceOptions
from nurbseg.drivers.process.messages import (
    Answer,
    Begin,
    Failed,
    Lost,
    Opened,
    Order,
    Playback,
    Recorded,
    RecordOptions,
    Status,
)
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)

#: The process must have opened a camera, or a recording, within this time, seconds.
_OPEN_LIMIT_S, _OPEN_RECORDING_LIMIT_S = 60.0, 600.0
#: And must end when it is to, besides the time for what is recorded.
_END_LIMIT_S = 30.0
#: A process without a heartbeat for this long hangs, seconds; it reports a silent camera itself.
_HANG_LIMIT_S = 10.0
#: Longest wait for a recording to begin, seconds.
_ANSWER_S = 10.0
#: Longest wait with the lock, seconds.
_SLICE_S = 0.05


class SourceProcess(FrameSource):
    """A camera or a recording, read by `nurbseg.drivers.process.program`.

    `read` and iteration give the newest frame of a camera that was not read yet: those that newer ones
    replaced are counted as `missed`, so a loop is never behind, however slow it is. Of a recording, or with
    `every`, they give every frame in its order; up to a second of a camera's waits for a late reader. What is
    damaged is passed over, logged and counted. A camera that is unplugged, or whose process crashes or hangs,
    is waited for as the options say.

    One thread reads; another one may pause, step, seek, change speed and loop, and record meanwhile.

    Parameters
    ----------
    uri : str
        As of `nurbseg.drivers.registry.open_source`.
    options : SourceOptions, optional
        What the recording does not say itself.
    playback : Playback, optional
        How it is played; without it, as fast as it is read, once.
    every : bool, optional
        Whether every frame is wanted, of a recording, or only the newest; without it, that depends on `live`.
    process : ChildProcess, optional
        One that runs the program already and has imported its libraries; owned.
    meanwhile : callable, optional
        What to do while the process opens the source.

    Raises
    ------
    DriverError
        What `open_source` raises, and RecordingFormatError or DeviceLostError if the process ends.

    Attributes
    ----------
    status : Status
        What the process said last: what was lost, damaged and recorded.
    paused : bool
        Whether only frames stepped or sought to are read, each at once; a camera is read on.
    speed : float or None
        Multiple of the recorded rate; None if frames come as fast as they are read.
    loop : bool or None
        Whether there is a further pass at the end; None if there cannot be.
    position : int
        Number of the frame taken last, or sought since.
    """

    def __init__(
        self,
        uri: str,
        options: SourceOptions | None = None,
        *,
        playback: Playback | None = None,
        every: bool | None = None,
        process: ChildProcess | None = None,
        meanwhile: Callable[[], object] = lambda: None,
    ) -> None:
        super().__init__()
        self.status = Status()
        self.position = 0
        self.paused = False
        self._uri, self._options = uri, options or SourceOptions()
        self._every = every if every is not None else self._options.every_frame or None
        self._device = self._options.device or DeviceOptions()
        self._playback = playback or Playback()
        self.speed = self._playback.speed
        self.loop: bool | None = None
        #: How many seconds what is being recorded has to be completed in on closing.
        self.drain_s = 60.0
        self._receiving = threading.RLock()
        self._is_reading = False
        self._opened: Opened | None = None
        self._failed: DriverError | OSError | ValueError | None = None
        self._answer: Answer | None = None
        self._recorded: dict[Path, Recorded] = {}
        self._recording: RecordOptions | None = None
        #: Seeks so far, and in a pause how many frames are still to be taken.
        self._jumps = self._to_take = 0
        self._replaced = 0
        self._newest: RGBDFrame | None = None
        self._last: RGBDFrame | None = None
        #: How often the process was started again since the last frame.
        self._fruitless = 0
        self._start(None, process)
        with closed_on_error(self.close):
            meanwhile()
            self._wait_for_opening()

    @property
    def losses(self) -> dict[str, int]:
        """What was lost before it could be read here, by reason."""
        return dict(self.status.losses)

    @property
    def connected(self) -> bool:
        """Whether a camera is there; if not, it is waited for."""
        return self.status.connected and self._failed is None

    @property
    def replaced(self) -> int:
        """Frames that were read but that newer ones replaced, also before the first that was taken."""
        return self._replaced + self._process.channel.skipped

    @property
    def recordings(self) -> tuple[Recorded, ...]:
        """What was recorded so far: each part that a process has written."""
        return tuple(self._recorded.values())

    def play(
        self, *, paused: bool | None = None, speed: float | None = None, loop: bool | None = None
    ) -> None:
        """Pause, so that only what is stepped or sought to is read, or go on; change speed or loop."""
        if speed is not None and not 0 < speed < float("inf"):
            raise ValueError(f"speed: expected more than 0, got {speed}")
        for name, value in (("paused", paused), ("speed", speed), ("loop", loop)):
            if value is not None:
                setattr(self, name, value)
                self._order(name, value)

    def step(self) -> None:
        """Pause, and take one more frame."""
        self.paused = True
        self._to_take += 1
        self._order("step")

    def wait(self, timeout_s: float) -> None:
        """Have the source read and recorded for so long, without a frame; raises what `read` raises."""
        self._begin()
        self._receive(min(timeout_s, _SLICE_S), "none")
        self._check_progress()
        if self._failed is not None:
            raise self._failed

    @property
    def waits(self) -> bool:
        """Whether it is paused, and all frames stepped or sought to were taken."""
        return self.paused and not self._to_take

    def record(self, options: RecordOptions) -> None:
        """Record the frames that come from now on, in place of what was recorded until now.

        Raises DriverError or OSError if the recording cannot be started.
        """
        self._answer = None
        self._order("record", options)
        deadline_s = time.monotonic() + _ANSWER_S
        while (answer := self._answer) is None:
            if self._failed is not None:
                raise self._failed
            if time.monotonic() > deadline_s:
                raise DriverError(f"{options.path}: the recording did not begin within {_ANSWER_S:g} s")
            self._receive(_SLICE_S, "none")
        if answer.error is not None:
            raise answer.error
        self._recording = options
        self._recorded[options.path] = Recorded(options.path, (options.path,))

    def end_recording(self) -> None:
        """Record no more frames; those that were taken are still written."""
        self._recording = None
        self._order("end_recording")

    def latest(self, max_age_ms: float) -> RGBDFrame:
        """Return the newest frame, as `FrameSource.latest` says."""
        if self._closed or not self.live:
            return super().latest(max_age_ms)
        self._begin()
        with self._receiving:
            self._receive(0.0, "none")
            if (newest := self._process.channel.take("newest", peek=True)) is not None:
                self._newest = newest
        if self._failed is not None:
            raise self._failed
        name = self.metadata.get("device", self._uri)
        if self._newest is None:
            raise FrameTimeoutError(f"{name}: no frame yet")
        assert self._newest.arrived_s is not None
        age_ms = 1e3 * (time.monotonic() - self._newest.arrived_s)
        if age_ms > max_age_ms:
            raise FrameTimeoutError(
                f"{name}: the newest frame came {age_ms:.0f} ms ago, over {max_age_ms:g} ms"
            )
        return self._newest

    def _seek(self, index: int) -> None:
        self._jumps += 1
        self.position = index
        self._to_take = int(self.paused)
        if isinstance(self._failed, EndOfRecordingError):
            self._failed = None
        self._order("seek", index)

    def _read(self, timeout_s: float) -> RGBDFrame:
        self._begin()
        deadline_s = time.monotonic() + timeout_s
        while True:
            left_s = deadline_s - time.monotonic()
            items: Items = "none" if self.waits else "next" if self._in_order else "newest"
            frame = self._receive(min(max(left_s, 0.0), _SLICE_S), items)
            if frame is None and self._failed is not None and not self.waits:
                # Frames came before.
                frame = self._process.channel.take(items)
                if frame is None:
                    raise self._failed
            if frame is not None and frame.jumps == self._jumps:
                return self._taken(frame)
            self._check_progress()
            if frame is None and left_s <= 0:
                name = self.metadata.get("device", self._uri)
                kind = "depth and color" if self.live else "frame"
                why = "the replay is paused" if self.paused else f"no {kind} within {timeout_s:g} s"
                raise FrameTimeoutError(f"{name}: {why}")

    @property
    def _in_order(self) -> bool:
        if self.live:
            return bool(self._every)
        return self.paused or self._every is not False

    def _taken(self, frame: RGBDFrame) -> RGBDFrame:
        if self._last is not None and frame.jumps == self._last.jumps:
            self.missed += max(0, frame.index - self._last.index - 1)
        self._to_take = max(0, self._to_take - 1)
        self.position = frame.index
        self._last = self._newest = frame
        self.calibration = frame.calibration
        self._fruitless = 0
        return frame

    def _begin(self) -> None:
        if not self._is_reading:
            self._is_reading = True
            self._order("read_on")

    def _order(self, name: str, argument: object = None) -> None:
        # Its last messages say why the process ended.
        with contextlib.suppress(ChannelClosedError):
            self._process.channel.send(Order(name, argument))

    def _receive(self, timeout_s: float, items: Items) -> RGBDFrame | None:
        """Receive a message, if one comes in time; return a frame, and take note of the others."""
        with self._receiving:
            try:
                message = self._process.channel.receive(timeout_s, items)
            except ChannelClosedError:
                self._note_end()
                return None
            if isinstance(message, RGBDFrame):
                return message
            if isinstance(message, Opened):
                self._opened = message
                self.calibration = message.calibration
                self.metadata.update(message.metadata)
            elif isinstance(message, Answer):
                self._answer = message
            elif isinstance(message, Status):
                self._note_status(message)
            elif isinstance(message, Failed):
                is_stale = isinstance(message.error, EndOfRecordingError) and message.jumps != self._jumps
                self._failed = self._failed if is_stale else message.error
            return None

    def _note_status(self, status: Status) -> None:
        self.status = status
        for each in status.recordings:
            files = self._recorded[each.path].files if each.path in self._recorded else ()
            self._recorded[each.path] = replace(each, files=tuple(dict.fromkeys((*files, *each.files))))

    def _note_end(self) -> None:
        """Take note of the end of the process; of a camera, look for it with another one."""
        if self._failed is None and not self._closed:
            how = self._process.ending(_END_LIMIT_S)
            if self._is_camera:
                driver = self.metadata.get("device", self._uri)
                self._lose(f"{driver}: its driver crashed the source process, which {how}")
            else:
                self._failed = RecordingFormatError(
                    f"{self._uri}: the source process {how}; the file is damaged"
                )

    @property
    def _is_camera(self) -> bool:
        return self._uri.startswith(tuple(f"{scheme}:" for scheme in CAMERAS)) or self.live

    def _check_progress(self) -> None:
        """Notice a process that hangs."""
        if self._process.hangs(_HANG_LIMIT_S):
            name = self.metadata.get("device", self._uri)
            if self._is_camera:
                self._lose(f"{name}: its driver hangs")
            else:
                self._failed = RecordingFormatError(f"{name}: reading it hangs")

    def _lose(self, reason: str) -> None:
        """Look for a lost camera by another process, if that is wanted; what is recorded goes on there."""
        self._process.end(0.0)
        if self._opened is None or not self._device.reconnect:
            self._failed = DeviceLostError(reason)
            return
        _log.warning("%s; waiting for it to come back", reason)
        self._process.close()
        self._replaced += self._process.channel.skipped
        self._recorded = {path: replace(each, ended=True) for path, each in self._recorded.items()}
        if self._recording is not None:
            part = part_after(self._recording.path, 1)
            self._recording = replace(self._recording, path=part, delay_s=0.0)
            self._recorded[part] = Recorded(part, (part,))
        lost = Lost(self.status, self._opened, self._recording, self._fruitless)
        if (last := self._last) is not None:
            lost = replace(lost, index=last.index, timestamp_ns=last.timestamp_ns, arrived_s=last.arrived_s)
        self._fruitless += 1
        self._start(lost)
        if self._is_reading:
            self._order("read_on")

    def _start(self, lost: Lost | None, process: ChildProcess | None = None) -> None:
        self._process = process or ChildProcess("nurbseg.drivers.process.program")
        level = logging.getLogger("nurbseg.drivers").getEffectiveLevel()
        begin = Begin(self._uri, self._options, self._playback, self._every, level, lost)
        with contextlib.suppress(ChannelClosedError):
            self._process.channel.send(begin)

    def _wait_for_opening(self) -> None:
        limit_s = _OPEN_LIMIT_S if self._is_camera else _OPEN_RECORDING_LIMIT_S
        deadline_s = time.monotonic() + limit_s
        while (opened := self._opened) is None:
            self._receive(_SLICE_S, "next")
            if self._failed is not None:
                raise self._failed
            if time.monotonic() > deadline_s:
                self._process.end(0.0)
                raise DeviceLostError(f"{self._uri}: was not opened within {limit_s:g} s; its driver hangs")
        self.depth_unit = opened.depth_unit
        self.live, self.seekable = opened.live, opened.seekable
        self.loop = None if self.live else self._playback.loop

    def _close(self) -> None:
        self._order("finish", self.drain_s)
        deadline_s = time.monotonic() + _END_LIMIT_S + self.drain_s * bool(self._recorded)
        with contextlib.suppress(ChannelClosedError), self._receiving:
            while time.monotonic() < deadline_s and not self._process.hangs(_END_LIMIT_S):
                if isinstance(message := self._process.channel.receive(_SLICE_S, "none"), Status):
                    self._note_status(message)
        self._process.close(max(0.0, min(2.0, deadline_s - time.monotonic())))
