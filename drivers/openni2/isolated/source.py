"""A camera that is read by a process of its own, as a source of frames."""

import contextlib
import logging
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nurbseg.drivers.closing import closed_on_error
from nurbseg.drivers.errors import DeviceLostError, DeviceNotFoundError, DriverError, FrameTimeoutError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.openni2.isolated.program import CODEC, CameraFrame, open_camera
from nurbseg.drivers.openni2.options import DeviceOptions, parse_mode
from nurbseg.drivers.process.channel import ChannelClosedError
from nurbseg.drivers.process.child import ChildProcess
from nurbseg.drivers.process.messages import Answer, Call
from nurbseg.drivers.source import FrameSource

#: The process must have opened the camera within this time, seconds.
_OPEN_LIMIT_S = 60.0
#: And must answer, and end when it is to, finishing a recording first.
_ANSWER_LIMIT_S = 30.0
#: A process that is silent for this long hangs, seconds; it reports a silent camera itself.
_HANG_LIMIT_S = 10.0
#: Frames that may wait, seconds; and some more, as several slots come free at a time.
_DEPTH_S, _MORE = 1.0, 4


def begin_process(options: DeviceOptions) -> ChildProcess:
    """Start a process that will read a camera, once an `IsolatedCamera` tells it which."""
    return ChildProcess("nurbseg.drivers.openni2.isolated.program", slots=_slots(options))


def _slots(options: DeviceOptions) -> int:
    fps = max(parse_mode(each)[2] for each in (options.depth_mode, options.color_mode))
    return max(4, round(fps * _DEPTH_S) + _MORE)


class IsolatedCamera(FrameSource):
    """Frames of a camera, read as `DeviceSource` does, but by another process.

    Up to a second of frames waits here for a reader that comes late; `missed` counts those that the camera
    delivered, but that were too late or too many, and `half_pairs` images whose other half never came within
    `pairing_limit_s`.

    `wanted` is interpreted by `nurbseg.drivers.openni2.selection.choose`. With `patience_s`, the process
    looks for a camera that is not there at this interval, seconds, and the source is usable once `is_open`
    says so. `process` is from `begin_process` with the same options, and ended with this source.

    Raises BackendMissingError if OpenNI2 is not installed, DeviceNotFoundError if there is no such camera or
    it cannot be opened, CalibrationError if the options name a calibration file that is damaged, and
    DriverError if the camera has no such streams or modes.
    """

    live = True

    def __init__(
        self,
        wanted: str = "any",
        options: DeviceOptions | None = None,
        *,
        pairing_limit_s: float = 0.02,
        patience_s: float | None = None,
        process: ChildProcess | None = None,
    ) -> None:
        super().__init__()
        self.missed = self.half_pairs = 0
        self._options = options or DeviceOptions()
        self._index = self._refused = 0
        self._begun = self._is_open = False
        self._frames: deque[CameraFrame] = deque()
        self._failure: DriverError | None = None
        self._slots = _slots(self._options)
        self._process = process or begin_process(self._options)
        self._channel = self._process.connect(CODEC)
        level = logging.getLogger("nurbseg.drivers").getEffectiveLevel()
        self._ask(open_camera.__name__, level, wanted, self._options, pairing_limit_s, patience_s)
        if patience_s is None:
            self._wait_until_open()

    def _wait_until_open(self) -> None:
        deadline = time.monotonic() + _OPEN_LIMIT_S
        with closed_on_error(self.close):
            while not self.is_open(deadline - time.monotonic()):
                if time.monotonic() >= deadline:
                    raise DeviceLostError(f"OpenNI2 did not open a camera within {_OPEN_LIMIT_S:g} s")

    def is_open(self, timeout_s: float = 0.0) -> bool:
        """Whether the camera is open; waits at most this long for an answer.

        Raises DriverError as on opening.
        """
        if not self._is_open and (answer := self._answer(timeout_s)) is not None:
            metadata, self.calibration = answer.result()
            self.metadata.update(metadata)
            self._is_open = True
        if not self._is_open and self._channel.silent_s > _OPEN_LIMIT_S:
            # A process that looks for its camera sends a heartbeat after each attempt.
            self._failure = self._failure or DeviceLostError("OpenNI2 cannot open a camera; its driver hangs")
        if not self._is_open and self._failure is not None:
            raise self._failure
        return self._is_open

    @property
    def losses(self) -> Mapping[str, int]:
        """Frames that were too late or too many for us, and images whose other half never came."""
        return {"missed": self.missed, "half_pairs": self.half_pairs}

    def start_recording(self, path: Path, *, lossy: bool = False) -> None:
        """Record with OpenNI2's recorder, as `DeviceSource.start_recording` does."""
        self._call("start_recording", str(path.absolute()), lossy)

    def stop_recording(self) -> None:
        """Finish the recording, as `DeviceSource.stop_recording` does."""
        self._call("stop_recording")

    def _ask(self, function: str, *arguments: Any) -> None:
        # Its earlier messages say why the process ended.
        with contextlib.suppress(ChannelClosedError):
            self._channel.send(Call(function, arguments))

    def _call(self, function: str, *arguments: Any) -> None:
        self._ask(function, *arguments)
        deadline = time.monotonic() + _ANSWER_LIMIT_S
        while time.monotonic() < deadline:
            answer = self._answer(deadline - time.monotonic())
            if self._failure is not None:
                raise self._failure
            if answer is not None and answer.function == function:
                answer.result()
                return
        raise DeviceLostError(f"OpenNI2 does not answer within {_ANSWER_LIMIT_S:g} s; its driver hangs")

    def _answer(self, timeout_s: float) -> Answer | None:
        """Return an answer, if one comes in time; frames are kept, and the camera's failure is noted."""
        try:
            message = self._channel.receive(max(0.0, timeout_s))
        except ChannelClosedError:
            if self._failure is None:
                code = self._process.end(_ANSWER_LIMIT_S)
                self._failure = DeviceLostError(f"OpenNI2's driver crashed the camera's process, code {code}")
            return None
        if isinstance(message, Answer):
            if message.function != open_camera.__name__ or message.raised is None:
                return message
            self._failure = message.raised
        elif message is not None and len(self._frames) < self._slots:
            self._frames.append(message)
        elif message is not None:
            self._refused += 1
        return None

    def _read(self, timeout_s: float) -> RGBDFrame:
        if not self._begun:
            self._begun = True
            self._ask("begin")
        deadline = time.monotonic() + timeout_s
        while not self._frames:
            if self._failure is not None:
                raise self._failure
            self._answer(deadline - time.monotonic())
            if self._frames or self._failure is not None:
                continue
            if self._channel.silent_s > _HANG_LIMIT_S:
                self._failure = DeviceLostError(f"{self.metadata['device']}: its driver hangs")
            elif time.monotonic() >= deadline:
                raise FrameTimeoutError(
                    f"{self.metadata['device']}: no depth and color within {timeout_s:g} s"
                )
        taken = self._frames.popleft()
        self.missed, self.half_pairs = taken.missed + self._refused, taken.half_pairs
        frame = RGBDFrame(
            index=self._index,
            timestamp_ns=taken.timestamp_ns,
            depth_mm=taken.depth_mm,
            color=taken.color,
            calibration=self.calibration,
        )
        self._index += 1
        return frame

    def _close(self) -> None:
        self._channel.finish()
        # Its last messages must be received before it can end.
        deadline = time.monotonic() + (_ANSWER_LIMIT_S if self._failure is None else 2.0)
        with contextlib.suppress(ChannelClosedError):
            while (left_s := deadline - time.monotonic()) > 0:
                self._channel.receive(left_s)
        self._process.close(max(0.0, deadline - time.monotonic()))


class Reopening:
    """Opens a camera again that was lost: each call asks one process, which looks for it, whether it is back.

    Another such process is kept ready: to start Python takes longer than all else that is done when a camera
    is plugged in again.
    """

    def __init__(self, wanted: str, options: DeviceOptions, pairing_limit_s: float) -> None:
        self._wanted, self._options, self._pairing_limit_s = wanted, options, pairing_limit_s
        self._ready: ChildProcess | None = begin_process(options)
        self._waiting: IsolatedCamera | None = None

    def __call__(self) -> IsolatedCamera:
        """Return the camera, open, for the caller to close; a DriverError says why it is not back."""
        if self._waiting is None:
            process, self._ready = self._ready or begin_process(self._options), None
            self._waiting = IsolatedCamera(
                self._wanted,
                self._options,
                pairing_limit_s=self._pairing_limit_s,
                patience_s=self._options.reconnect_interval_s,
                process=process,
            )
        try:
            is_open = self._waiting.is_open()
        except DriverError:
            self.close()
            raise
        if not is_open:
            raise DeviceNotFoundError("the camera is disconnected")
        camera, self._waiting = self._waiting, None
        self._ready = begin_process(self._options)
        return camera

    def close(self) -> None:
        """Stop looking for the camera; safe to repeat."""
        waiting, self._waiting = self._waiting, None
        ready, self._ready = self._ready, None
        for each in (waiting, ready):
            if each is not None:
                each.close()
