"""A thread that reads frames from the source and queues them."""

from __future__ import annotations

import logging
import queue
import statistics
import threading
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import EndOfRecordingError, FrameFormatError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.common.process.bounded_queue import BoundedQueue
from nurbseg.drivers.source import FrameSource
from nurbseg.segmentation.points.depth_preparation import DepthPreparation

if TYPE_CHECKING:
    from nurbseg.app.recording.recording import Recording

_log = logging.getLogger(__name__)

#: Longest wait of one read, seconds; stopping takes at most this long.
_READ_TIMEOUT_S = 0.5
#: Pause after a read that failed, seconds: a source may fail at once each time.
_ERROR_PAUSE_S = 0.01
#: Longest wait for a pending read when the run ends, seconds: a file on a dead disk never answers.
_STOP_TIMEOUT_S = 5.0
#: Number of damaged frames that are logged; further ones are only counted.
_DAMAGED_NAMED_MAX = 20
#: Number of periods whose median gives the rate of the source.
_PERIODS = 15


@dataclass(frozen=True, slots=True, eq=False)
class Captured:
    """A frame and its time of arrival, `time.monotonic` seconds."""

    frame: RGBDFrame
    arrived_s: float


class CaptureThread:
    """Reads a source on its own thread and queues the frames.

    It borrows the source: leave the ``with`` block before closing it. Damaged frames are logged, counted and
    skipped; `frames.take` raises any other error of the source, after the frames before it. If `lossless`,
    the source waits for the consumer; otherwise newer frames replace older ones. Every frame first goes to
    `recording` (only there, while the recording is behind) and then through `preparation`. The first frame
    without any depth is logged.
    """

    def __init__(
        self,
        source: FrameSource,
        recording: Recording | None = None,
        *,
        lossless: bool = False,
        preparation: DepthPreparation | None = None,
    ) -> None:
        self._preparation = preparation
        #: The recording that was chosen last, which the next frame goes to.
        self.recording: Recording | None = None
        self.frames: BoundedQueue[Captured] = BoundedQueue(1, "wait" if lossless else "drop oldest")
        #: Frames read, frames not queued because the recording was behind, and damaged frames.
        self.read = self.withheld = self.damaged = 0
        #: What is wrong with the first damaged frames.
        self.damaged_frames: list[str] = []
        #: Measured frame rate of the source; 0 if unknown.
        self.source_hz = 0.0
        self._warned_empty = False
        self._recordings: queue.SimpleQueue[Recording | None] = queue.SimpleQueue()
        self.record(recording)
        self._periods_s: deque[float] = deque(maxlen=_PERIODS)
        self._source = source
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="capture")

    def __enter__(self) -> Self:
        # Ctrl-C may come between the start and its confirmation.
        with closed_on_error(self.stop):
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def losses(self) -> Mapping[str, int]:
        """Frames that the source lost before they could be read, by reason."""
        return self._source.losses

    def record(self, recording: Recording | None) -> None:
        """Finish the current recording, and record the following frames to another one, or none."""
        self.recording = recording
        self._recordings.put(recording)

    def stop(self) -> None:
        """Stop reading; wait a few seconds at most for a pending read."""
        self._stop.set()
        self.frames.discard()
        if self._thread.ident is not None:
            self._thread.join(_STOP_TIMEOUT_S)
            if self._thread.is_alive():
                _log.error("the source did not respond within %g s and was abandoned", _STOP_TIMEOUT_S)

    def _run(self) -> None:
        before: Captured | None = None
        recording: Recording | None = None
        try:
            while not self._stop.is_set():
                with suppress(queue.Empty):
                    while True:
                        following = self._recordings.get_nowait()
                        if recording is not None:
                            recording.finish()
                        recording = following
                try:
                    frame = self._source.read(_READ_TIMEOUT_S)
                except FrameTimeoutError:
                    self._stop.wait(_ERROR_PAUSE_S)
                    continue
                except FrameFormatError as err:
                    self._pass_over(err)
                    if self._source.live:
                        # A recording ends; a camera may go on like this.
                        self._stop.wait(_ERROR_PAUSE_S)
                    continue
                self.read += 1
                captured = Captured(frame, time.monotonic())
                self._take_period(before, captured)
                before = captured
                if recording is not None:
                    recording.put(frame)
                    if recording.behind:
                        self.withheld += 1
                        continue
                if self._preparation is not None:
                    captured = replace(captured, frame=self._preparation.prepared(frame))
                self._warn_if_empty(captured.frame)
                if not self.frames.put(captured):
                    return
            self.frames.close()
        except EndOfRecordingError:
            self.frames.close()
        except BaseException as err:
            # The worker raises this.
            self.frames.close(err)
        finally:
            if recording is not None:
                recording.finish()

    def _take_period(self, before: Captured | None, captured: Captured) -> None:
        """Add the period between two frames to the statistics, allowing for frames lost in between."""
        if before is None or captured.frame.jumps != before.frame.jumps:
            return
        frames = captured.frame.index - before.frame.index
        if frames <= 0:
            return
        self._periods_s.append((captured.arrived_s - before.arrived_s) / frames)
        if len(self._periods_s) == _PERIODS:
            self.source_hz = 1.0 / max(statistics.median(self._periods_s), 1e-9)

    def _warn_if_empty(self, frame: RGBDFrame) -> None:
        if not self._warned_empty and not frame.depth_mm.any():
            self._warned_empty = True
            _log.warning(
                "frame %d: no pixel has depth; check --depth-scale, --range-min, --range-max and --crop, or "
                "what the camera sees",
                frame.index,
            )

    def _pass_over(self, err: FrameFormatError) -> None:
        self.damaged += 1
        if self.damaged <= _DAMAGED_NAMED_MAX:
            self.damaged_frames.append(str(err))
            _log.warning("skipped a damaged frame: %s", err)
        elif self.damaged == _DAMAGED_NAMED_MAX + 1:
            _log.warning(
                "skipped more than %d damaged frames; from now on they are only counted", _DAMAGED_NAMED_MAX
            )
