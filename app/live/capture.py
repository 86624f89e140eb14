"""From the source to the worker: a thread that reads frames and leaves them in a queue."""

from __future__ import annotations

import logging
import queue
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from nurbseg.drivers.errors import EndOfRecordingError, FrameFormatError, FrameTimeoutError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.process.bounded_queue import BoundedQueue
from nurbseg.drivers.source import FrameSource, Paced
from nurbseg.segmentation.points.depth_preparation import DepthPreparation

if TYPE_CHECKING:
    from nurbseg.app.recording.recording import Recording

_log = logging.getLogger(__name__)

#: Longest wait of one read, seconds; stopping takes at most this long.
_READ_TIMEOUT_S = 0.5
#: Longest wait for the read that is under way when the run ends: a file on a dead disk never answers.
_STOP_TIMEOUT_S = 5.0
#: Damaged frames that are logged one by one; the others are counted.
_DAMAGED_NAMED_MAX = 20
#: Time between two looks whether a pause is over, seconds.
PAUSE_LOOK_S = 0.05
#: Periods of which the median is taken for the rate of the source.
_PERIODS = 15


@dataclass(frozen=True, slots=True, eq=False)
class Captured:
    """A frame and when it came.

    Parameters
    ----------
    frame : RGBDFrame
        The frame.
    arrived_s : float
        When the source handed it out, `time.monotonic` seconds.
    jumps : int
        How often reading had gone to another frame before.
    """

    frame: RGBDFrame
    arrived_s: float
    jumps: int = 0


class CaptureThread:
    """Reads a source on a thread of its own and leaves the frames in a queue.

    It borrows the source: stop the thread (leave the ``with`` block) before closing that. A damaged
    frame is named in the log, counted, and passed over; every other error of the source comes out of
    the queue's `take`, after the frames read before it.

    Parameters
    ----------
    source : FrameSource
        Read by this thread alone from now on.
    lossless : bool
        Whether the source waits for the consumer instead of running on.
    recording : Recording, optional
        Gets every frame first; while it is behind, frames are not left in the queue. `record` changes it.
    preparation : DepthPreparation, optional
        What is done to their depth after that.

    Attributes
    ----------
    frames : BoundedQueue of Captured
        Where the frames are left, one at a time; its `dropped` counts those that a newer one replaced.
    read : int
        Frames read.
    source_hz : float
        Rate of the source, by when its frames come; 0 as long as it is not known.
    withheld : int
        Frames that were not left in the queue, because the recording was behind.
    jumps : int
        How often reading was asked to go to another frame; those of before have fewer `jumps`.
    damaged : int
        Frames that could not be read.
    damaged_frames : list of str
        What was wrong with the first of them.
    """

    def __init__(
        self,
        source: FrameSource,
        *,
        lossless: bool = False,
        recording: Recording | None = None,
        preparation: DepthPreparation | None = None,
    ) -> None:
        self._preparation = preparation
        self.recording = recording
        self.withheld = 0
        self.frames: BoundedQueue[Captured] = BoundedQueue(1, "wait" if lossless else "drop oldest")
        self.read = 0
        self.damaged = 0
        self.damaged_frames: list[str] = []
        self.source_hz = 0.0
        self.jumps = self._jumps = 0
        self._paused = False
        self._steps = 0
        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._periods_s: deque[float] = deque(maxlen=_PERIODS)
        self._source = source
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="capture")

    def __enter__(self) -> Self:
        try:
            self._thread.start()
        except BaseException:
            # Ctrl-C may come between the start and its confirmation.
            self.stop()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def losses(self) -> Mapping[str, int]:
        """What the source lost before it could be read, counted by reason."""
        return self._source.losses

    @property
    def speed(self) -> float:
        """Multiple of the recorded rate that a replay is paced by; 0 where it is not."""
        return self._source.speed if isinstance(self._source, Paced) else 0.0

    @speed.setter
    def speed(self, speed: float) -> None:
        if isinstance(self._source, Paced):
            self._source.speed = speed

    def pause(self, paused: bool) -> None:
        """Read nothing for now, or go on where reading ended."""
        self._paused = paused
        self._restart()

    def step(self) -> None:
        """Read one more frame while paused."""
        self._requests.put(self._step)

    def seek(self, index: int) -> None:
        """Go on reading at a frame; while paused, read this one frame."""
        self.jumps += 1
        jumps = self.jumps
        self._requests.put(lambda: self._seek(index, jumps))

    def record(self, recording: Recording | None) -> None:
        """Record the frames that follow to another file, or none; the recording before is finished."""
        self._requests.put(lambda: self._record(recording))

    def _step(self) -> None:
        self._steps += 1
        self._restart()

    def _seek(self, index: int, jumps: int) -> None:
        self._source.seek(index)
        self._jumps = jumps
        self._steps = 1 if self._paused else 0

    def _record(self, recording: Recording | None) -> None:
        if self.recording is not None:
            self.recording.finish()
        self.recording = recording

    def _restart(self) -> None:
        if isinstance(self._source, Paced):
            self._source.restart()

    def stop(self) -> None:
        """Stop reading, and wait for the read that is under way, a few seconds at most."""
        self._stop.set()
        self.frames.discard()
        if self._thread.ident is not None:
            self._thread.join(_STOP_TIMEOUT_S)
            if self._thread.is_alive():
                _log.error("the source did not respond within %g s and was abandoned", _STOP_TIMEOUT_S)

    def _run(self) -> None:
        before: Captured | None = None
        try:
            while not self._stop.is_set():
                with suppress(queue.Empty):
                    while True:
                        self._requests.get_nowait()()
                if self._paused and not self._steps:
                    self._stop.wait(PAUSE_LOOK_S)
                    continue
                try:
                    frame = self._source.read(_READ_TIMEOUT_S)
                except FrameTimeoutError:
                    continue
                except FrameFormatError as err:
                    self._pass_over(err)
                    continue
                self.read += 1
                self._steps = max(0, self._steps - 1)
                captured = Captured(frame, time.monotonic(), self._jumps)
                self._take_period(before, captured)
                before = captured
                if self.recording is not None:
                    self.recording.put(frame)
                    if self.recording.behind:
                        self.withheld += 1
                        continue
                if self._preparation is not None:
                    captured = replace(captured, frame=self._preparation.prepared(frame))
                if not self.frames.put(captured):
                    return
            self.frames.close()
        except EndOfRecordingError:
            self.frames.close()
        except BaseException as err:
            # A thread that dies is never silent: the worker raises this.
            self.frames.close(err)
        finally:
            if self.recording is not None:
                self.recording.finish()

    def _take_period(self, before: Captured | None, captured: Captured) -> None:
        """Take note of the time between two frames, frames that were lost in between included."""
        if before is None or captured.jumps != before.jumps or captured.frame.index <= before.frame.index:
            return
        frames = captured.frame.index - before.frame.index
        self._periods_s.append((captured.arrived_s - before.arrived_s) / frames)
        if len(self._periods_s) == _PERIODS:
            self.source_hz = 1.0 / max(statistics.median(self._periods_s), 1e-9)

    def _pass_over(self, err: FrameFormatError) -> None:
        self.damaged += 1
        if self.damaged <= _DAMAGED_NAMED_MAX:
            self.damaged_frames.append(str(err))
            _log.warning("skipped a damaged frame: %s", err)
        elif self.damaged == _DAMAGED_NAMED_MAX + 1:
            _log.warning(
                "skipped more than %d damaged frames; from now on they are only counted", _DAMAGED_NAMED_MAX
            )
