"""A source of frames that a program has itself."""

import threading
import time
from dataclasses import replace

from nurbseg.common.errors import DriverError, EndOfRecordingError, FrameTimeoutError
from nurbseg.common.frame import Calibration, RGBDFrame, check_frame
from nurbseg.common.process.bounded_queue import BoundedQueue
from nurbseg.drivers.live.shared import SharedCamera
from nurbseg.drivers.source import FrameSource

#: Frames that may wait for the thread that hands them to readers, which takes microseconds for each.
_WAITING_MAX = 8


class FramesSource(SharedCamera):
    """The frames that a program puts in, as a camera's: each reader has the newest, or every one.

    `put` may be called from any thread, such as a driver's callback, and never waits for those who read.

    Parameters
    ----------
    calibration : Calibration
        Of the first frames; each has its own, too.
    silence_s : float
        Longest wait for a frame, seconds, in a loop and unless `read` is told another.
    """

    def __init__(self, calibration: Calibration, *, silence_s: float = 10.0) -> None:
        self._inbox = _Inbox(calibration)
        super().__init__(self._inbox)
        self.silence_s = silence_s

    def put(self, frame: RGBDFrame) -> None:
        """Hand a frame to the readers.

        Frames are numbered in order; one without a time (``timestamp_ns`` 0) gets the present one.

        Raises
        ------
        DriverError
            If the source is closed or was ended.
        TypeError
            If the frame is something else.
        """
        check_frame(frame)
        self._inbox.put(frame)

    def end(self) -> None:
        """Say that no more frames come: loops end after what was put."""
        self._inbox.queue.close()

    def read(self, timeout_s: float | None = None) -> RGBDFrame:
        """Return the newest frame that was not read yet, as `FrameSource.read` says.

        Raises EndOfRecordingError after the last one.
        """
        return super().read(self.silence_s if timeout_s is None else timeout_s)


class _Inbox(FrameSource):
    """Where frames are put, and from where they are handed out."""

    live = True

    def __init__(self, calibration: Calibration) -> None:
        super().__init__()
        self.calibration = calibration
        self.metadata["device"] = "the program's frames"
        self.queue: BoundedQueue[RGBDFrame] = BoundedQueue(_WAITING_MAX, "drop oldest")
        self._count, self._putting = 0, threading.Lock()

    def put(self, frame: RGBDFrame) -> None:
        # Frames of several threads are queued in the order of their numbers.
        with self._putting:
            stamped = replace(frame, index=self._count, timestamp_ns=frame.timestamp_ns or time.time_ns())
            self._count += 1
            is_open = self.queue.put(stamped)
        if not is_open:
            raise DriverError("FramesSource: no frame can be put any more: it is closed, or was ended")

    def _read(self, timeout_s: float) -> RGBDFrame:
        try:
            frame = self.queue.take(timeout_s)
        except TimeoutError as err:
            raise FrameTimeoutError(f"{self.metadata['device']}: no frame within {timeout_s:g} s") from err
        if frame is None:
            raise EndOfRecordingError("the program has ended its frames")
        return frame

    def _close(self) -> None:
        self.queue.discard()
