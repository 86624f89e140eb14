"""Recording to .mcap: a queue and a thread between a source and the file."""

import contextlib
import logging
import math
import shutil
import threading
from pathlib import Path

from nurbseg.common.closing import Closing
from nurbseg.common.errors import DriverError
from nurbseg.common.files import check_absent, part_after, remove_output
from nurbseg.common.frame import RGBDFrame
from nurbseg.common.process.bounded_queue import BoundedQueue
from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.process.messages import Recorded, RecordOptions
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)

#: A longer time between two frames, nanoseconds, is a jump of the clock.
_LONGEST_GAP_NS = 10_000_000_000
#: Maximum size of the queue: about five seconds of VGA frames at 30 Hz.
_QUEUE_BYTES_MAX = 240_000_000
#: Parts that a state lists, the newest: a message has no room for those of days.
_FILES_TOLD = 100
#: Longest wait for the frame that is being written, seconds.
_LAST_FRAME_S = 10.0


def free_space(path: Path) -> int:
    """Return the free space for a file, bytes."""
    return shutil.disk_usage(path.parent).free


class Recording(Closing):
    """Queues frames and writes them on its own thread, to a new file every ``options.split_s`` seconds.

    If the queue is full, a frame is lost and counted or, if `lossless`, waits. If the disk is nearly full or
    writing fails, the file is closed and remains readable, and `state` says why. One thread calls everything
    but `state`. Raises DriverError if the disk is too full to begin, OSError if the file exists or cannot be
    created.
    """

    def __init__(self, options: RecordOptions, source: FrameSource, *, lossless: bool = False) -> None:
        path = options.path
        check_absent(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._options, self._source = options, source
        #: Frames that were to be recorded, and those in the file.
        self._wanted = self._frames = 0
        self._seconds = self._written_mb = self._room_mb = 0.0
        self._failure = ""
        self._first_ns: int | None = None
        self._has_begun = False
        self._last_ns: int | None = None
        self._files: tuple[Path, ...] = (path,)
        if missing := self._shortage():
            least = f"recording stops at {options.space_min_mb} MB (--set space_min_mb=N)"
            raise DriverError(f"{path}: {missing}, and {least}")
        self._split_ns = math.inf if options.split_s is None else round(options.split_s * 1e9)
        #: Time of the first frame in the current file.
        self._began_ns: int | None = None
        self._writer = self._opened(path)
        self._queue: BoundedQueue[RGBDFrame] = BoundedQueue(
            _QUEUE_BYTES_MAX,
            "wait" if lossless else "refuse",
            lambda frame: frame.depth_mm.nbytes + frame.color.nbytes,
        )
        self._thread = threading.Thread(target=self._run, name="recording")
        self._thread.start()

    def state(self) -> Recorded:
        """Return what was recorded so far."""
        return Recorded(
            self._files[0],
            # The client knows the others.
            self._files[-_FILES_TOLD:],
            self._frames,
            # What waits is not lost yet.
            self._queue.dropped
            if self._thread.is_alive() and not self._failure
            else self._wanted - self._frames,
            self._seconds,
            self._written_mb,
            self._room_mb,
            self._failure,
            ended=not self._thread.is_alive(),
        )

    def put(self, frame: RGBDFrame, timeout_s: float) -> bool:
        """Queue a frame; return whether it is done with, which one that has to wait is not."""
        if self._is_early(frame):
            return True
        try:
            self._queue.put(frame, timeout_s)
        except TimeoutError:
            return False
        self._add_time(frame)
        self._wanted += 1
        return True

    def finish(self) -> None:
        """Accept no more frames; queued ones are still written."""
        self._queue.close()

    def close(self, timeout_s: float = 60.0) -> None:
        """Write the queue and finish the file; frames not written in time are lost and counted."""
        self.finish()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self._queue.discard()
            # Only the current frame is left, which a dead disk never finishes.
            self._thread.join(_LAST_FRAME_S)
            if self._thread.is_alive():
                path = self._options.path
                self._failure = self._failure or f"{path}: the disk could not store the last frame"
                return
        if self._frames == 0:
            remove_output(self._options.path)

    def _opened(self, path: Path) -> RecordingWriter:
        return RecordingWriter(
            path,
            self._source.calibration,
            color_format=self._options.color,
            metadata=self._source.metadata,
        )

    def _is_early(self, frame: RGBDFrame) -> bool:
        """Whether a frame belongs to the delay before the recording, by its timestamp."""
        if self._first_ns is None or frame.timestamp_ns < self._first_ns:
            # The camera's clock may have been set back.
            self._first_ns = frame.timestamp_ns
        self._has_begun |= frame.timestamp_ns - self._first_ns >= round(1e9 * self._options.delay_s)
        return not self._has_begun

    def _add_time(self, frame: RGBDFrame) -> None:
        """Add the time since the previous frame, unless the camera's clock was reset."""
        if self._last_ns is not None and 0 < frame.timestamp_ns - self._last_ns < _LONGEST_GAP_NS:
            self._seconds += (frame.timestamp_ns - self._last_ns) / 1e9
        self._last_ns = frame.timestamp_ns

    def _shortage(self) -> str:
        """Return a message if the disk is nearly full, or an empty text."""
        free_bytes = free_space(self._options.path)
        self._room_mb = free_bytes / 1e6 - self._options.space_min_mb
        enough = free_bytes >= self._options.space_min_mb * 1_000_000
        return "" if enough else f"only {free_bytes // 1_000_000} MB of disk space are left"

    def _run(self) -> None:
        try:
            try:
                for frame in self._queue:
                    if missing := self._shortage():
                        raise DriverError(missing)
                    self._write(frame)
                    self._frames += 1
                    self._written_mb = self._size_mb()
            finally:
                self._writer.close()
                self._written_mb = self._size_mb()
        except Exception as err:
            # The run continues without the recording, and reports it at the end.
            self._fail(err)

    def _size_mb(self) -> float:
        """Return the size of the files, 10^6 bytes; waits for a disk that does not answer."""
        size_bytes = 0
        for file in self._files:
            with contextlib.suppress(FileNotFoundError):  # It may be deleted at any moment.
                size_bytes += file.stat().st_size
        return round(size_bytes / 1e6, 1)

    def _write(self, frame: RGBDFrame) -> None:
        if not self._files[-1].exists():
            # Its disk space would not be free until it is closed.
            raise DriverError(f"{self._files[-1]} was deleted or moved")
        if self._began_ns is None or frame.timestamp_ns < self._began_ns:
            self._began_ns = frame.timestamp_ns
        elif frame.timestamp_ns - self._began_ns >= self._split_ns:
            self._writer.close()
            part = part_after(self._options.path, len(self._files))
            self._writer = self._opened(part)
            self._files += (part,)
            self._began_ns = frame.timestamp_ns
        self._writer.write(frame)

    def _fail(self, err: Exception) -> None:
        reason = err.strerror if isinstance(err, OSError) and err.strerror else str(err)
        self._queue.discard()
        self._failure = f"{self._options.path}: recording stopped: {reason}"
        _log.error("%s; %d frames are in the file", self._failure, self._frames)
