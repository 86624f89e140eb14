"""Recording by ourselves: a queue and a thread of its own between the camera and the file."""

from __future__ import annotations

import contextlib
import logging
import threading
from pathlib import Path

from nurbseg.app.recording.config import RecordConfig
from nurbseg.app.recording.parts import PartedWriter
from nurbseg.app.recording.recording import Recording
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.process.bounded_queue import BoundedQueue

_log = logging.getLogger(__name__)

#: What may wait to be written: about five seconds of VGA frames at 30 Hz.
_QUEUE_BYTES_MAX = 240_000_000
#: Share of that from which on the live path gives way.
_BEHIND_SHARE = 0.4
_WAIT_S = 0.5
#: How long writing what waits may take at the end, seconds: of a run that ended, and of one interrupted.
_DRAIN_S, _INTERRUPTED_DRAIN_S = 60.0, 1.2
#: Longest wait for the one frame that is being written.
_LAST_FRAME_S = 10.0


class QueuedRecording(Recording):
    """Takes frames from the thread that captures them and writes them on a thread of its own.

    A frame that finds the queue full is lost and counted, or waits if nothing is to be lost; before that,
    from `behind` on, the capture thread keeps frames from being segmented, which leaves the processor to the
    recording. When the disk is nearly full, or a write fails, the file is closed, to be read up to there, and
    `failure` says why. The writer is closed with this.
    """

    def __init__(self, writer: PartedWriter, config: RecordConfig, *, lossless: bool = False) -> None:
        super().__init__(writer.files[0], config)
        self._writer = writer
        self._lossless = lossless
        self._queue: BoundedQueue[RGBDFrame] = BoundedQueue(
            _QUEUE_BYTES_MAX,
            "wait" if lossless else "refuse",
            lambda frame: frame.depth_mm.nbytes + frame.color.nbytes,
        )
        self._behind_bytes = _BEHIND_SHARE * _QUEUE_BYTES_MAX
        self._in_hand = 0
        self._thread = threading.Thread(target=self._run, name="recording")
        self._thread.start()

    @property
    def files(self) -> tuple[Path, ...]:
        """The files; more than one where the recording is split."""
        return self._writer.files

    @property
    def behind(self) -> bool:
        """As every recording's; never for a lossless one, whose source waits instead."""
        return not self._lossless and self._queue.filled > self._behind_bytes

    @property
    def ended(self) -> bool:
        """Whether nothing more is written."""
        return self._queue.closed

    @property
    def finished(self) -> bool:
        """Whether what came is written, after `finish` or a failure."""
        return not self._thread.is_alive()

    def put(self, frame: RGBDFrame) -> None:
        """Have a frame written; never waits, unless the recording is lossless and the queue full."""
        if self._is_early(frame):
            return
        self._add_time(frame)
        if not self._queue.put(frame):
            self.lost += 1

    def _run(self) -> None:
        try:
            try:
                while (frame := self._next()) is not None:
                    self._in_hand = 1
                    if missing := self._shortage():
                        raise DriverError(missing)
                    self._writer.write(frame)
                    self.frames += 1
                    self._in_hand = 0
            finally:
                self._writer.close()
        except Exception as err:
            # Whatever it is, the run goes on without the recording, and says so at its end.
            self._fail(err)

    def _next(self) -> RGBDFrame | None:
        """Return the frame that is due; None after the last one."""
        while True:
            with contextlib.suppress(TimeoutError):
                return self._queue.take(_WAIT_S)

    def _fail(self, err: Exception) -> None:
        reason = err.strerror if isinstance(err, OSError) and err.strerror else str(err)
        self.failure = f"{self.path}: recording stopped: {reason}"
        self.lost += self._queue.discard() + self._in_hand
        _log.error("%s; %d frames are in the file", self.failure, self.frames)

    def finish(self) -> None:
        """Say that no frame follows; what waits is written."""
        self._queue.close()

    def close(self, timeout_s: float = _DRAIN_S) -> None:
        """Write what waits and finish the file, once. What waits too long is lost, and counted."""
        self.finish()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self.lost += self._queue.discard()
            # What is left is the frame that is being written; a dead disk never finishes it.
            self._thread.join(_LAST_FRAME_S)
            if self._thread.is_alive():
                self.failure = self.failure or f"{self.path}: the disk could not store the last frame"
                return
        if self.frames == 0:
            self.path.unlink(missing_ok=True)

    def __exit__(self, *exception: object) -> None:
        interrupted = isinstance(exception[1], KeyboardInterrupt)
        self.close(_INTERRUPTED_DRAIN_S if interrupted else _DRAIN_S)
