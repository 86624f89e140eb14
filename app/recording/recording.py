"""Recording to .mcap: a queue and a thread between the camera and the file."""

import contextlib
import logging
import math
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nurbseg.app.settings.output_config import RecordConfig
from nurbseg.common.closing import Closing
from nurbseg.common.errors import DriverError
from nurbseg.common.files import part_after, remove_output
from nurbseg.common.frame import RGBDFrame
from nurbseg.common.process.bounded_queue import BoundedQueue
from nurbseg.drivers.mcap.writer import RecordingWriter

_log = logging.getLogger(__name__)

#: A longer time between two frames, nanoseconds, is a jump of the clock.
_LONGEST_GAP_NS = 10_000_000_000
#: Maximum size of the queue: about five seconds of VGA frames at 30 Hz.
_QUEUE_BYTES_MAX = 240_000_000
#: Share of that above which frames are only recorded.
_BEHIND_SHARE = 0.4
#: Time limit for writing the queue at the end of a run, and of an interrupted one, seconds.
_DRAIN_S, _INTERRUPTED_DRAIN_S = 60.0, 1.2
#: Longest wait for the frame that is being written, seconds.
_LAST_FRAME_S = 10.0


def free_space(path: Path) -> int:
    """Return the free space for a file, bytes."""
    return shutil.disk_usage(path.parent).free


class Recording(Closing):
    """Queues frames and writes them on its own thread, to a new file every ``config.split_s`` seconds.

    `path` is the first file.
    If the queue is full, a frame is lost and counted or, if `lossless`, waits. Before that, while `behind`,
    the capture thread does not pass frames on, which leaves the processor to the recording. If the disk is
    nearly full or writing fails, the file is closed and remains readable, and `failure` says why.
    Raises DriverError if the disk is too full to begin, OSError if the file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        open_file: Callable[[Path], RecordingWriter],
        config: RecordConfig,
        *,
        lossless: bool = False,
    ) -> None:
        self.path = path
        #: Frames recorded, and frames missing from the recording.
        self.frames = self.lost = 0
        #: Length by the frames' timestamps, including missing frames.
        self.seconds = 0.0
        #: Why the recording ended before the run did.
        self.failure = ""
        #: Size of the files after the last frame, and the disk space they may still use, 10^6 bytes.
        self.written_mb = self.room_mb = 0.0
        self._delay_ns = round(config.delay_s * 1e9)
        self._space_min_mb = config.space_min_mb
        self._first_ns: int | None = None
        self._has_begun = False
        self._last_ns: int | None = None
        if missing := self._shortage():
            least = f"recording stops at {config.space_min_mb} MB (--set space_min_mb=N)"
            raise DriverError(f"{path}: {missing}, and {least}")
        #: Several if the recording is split.
        self.files: tuple[Path, ...] = (path,)
        self._open_file = open_file
        self._split_ns = math.inf if config.split_s is None else round(config.split_s * 1e9)
        #: Time of the first frame in the current file.
        self._began_ns: int | None = None
        self._writer = open_file(path)
        self._lossless = lossless
        self._queue: BoundedQueue[RGBDFrame] = BoundedQueue(
            _QUEUE_BYTES_MAX,
            "wait" if lossless else "refuse",
            lambda frame: frame.depth_mm.nbytes + frame.color.nbytes,
        )
        self._putting = threading.Lock()
        self._behind_bytes = _BEHIND_SHARE * _QUEUE_BYTES_MAX
        self._in_hand = 0
        self._thread = threading.Thread(target=self._run, name="recording")
        self._thread.start()

    @property
    def size_mb(self) -> float:
        """Size of the files now, 10^6 bytes; waits for a disk that does not answer."""
        size_bytes = 0
        for file in self.files:
            with contextlib.suppress(FileNotFoundError):  # It may be deleted at any moment.
                size_bytes += file.stat().st_size
        return round(size_bytes / 1e6, 1)

    @property
    def behind(self) -> bool:
        """Whether the queue is so full that nothing else should use the processor; never if lossless."""
        return not self._lossless and self._queue.filled > self._behind_bytes

    @property
    def ended(self) -> bool:
        """Whether no more frames are written."""
        return self._queue.closed

    @property
    def finished(self) -> bool:
        """Whether all frames are written, after `finish` or a failure."""
        return not self._thread.is_alive()

    def put(self, frame: RGBDFrame) -> None:
        """Queue a frame, and wait only if the recording is lossless and the queue full.

        Call it from the thread that reads the source, as `finish`.
        """
        if self._is_early(frame):
            return
        self._add_time(frame)
        taken = self._queue.put(frame)
        with self._putting:
            self.lost += not taken

    def figures(self) -> dict[str, Any]:
        """Return the recording's entry in the run's report."""
        return {
            "file": str(self.path),
            "files": [str(file) for file in self.files],
            "frames": self.frames,
            "lost": self.lost,
            "megabytes": self.size_mb,
            "failure": self.failure,
        }

    def _is_early(self, frame: RGBDFrame) -> bool:
        """Whether a frame belongs to the delay before the recording, by its timestamp."""
        if self._first_ns is None or frame.timestamp_ns < self._first_ns:
            # The camera's clock may have been set back.
            self._first_ns = frame.timestamp_ns
        self._has_begun |= frame.timestamp_ns - self._first_ns >= self._delay_ns
        return not self._has_begun

    def _add_time(self, frame: RGBDFrame) -> None:
        """Add the time since the previous frame, unless the camera's clock was reset."""
        if self._last_ns is not None and 0 < frame.timestamp_ns - self._last_ns < _LONGEST_GAP_NS:
            self.seconds += (frame.timestamp_ns - self._last_ns) / 1e9
        self._last_ns = frame.timestamp_ns

    def _shortage(self) -> str:
        """Return a message if the disk is nearly full, or an empty text."""
        free_bytes = free_space(self.path)
        self.room_mb = free_bytes / 1e6 - self._space_min_mb
        enough = free_bytes >= self._space_min_mb * 1_000_000
        return "" if enough else f"only {free_bytes // 1_000_000} MB of disk space are left"

    def _run(self) -> None:
        try:
            try:
                for frame in self._queue:
                    self._in_hand = 1
                    if missing := self._shortage():
                        raise DriverError(missing)
                    self._write(frame)
                    self.frames += 1
                    self._in_hand = 0
                    self.written_mb = self.size_mb
            finally:
                self._writer.close()
        except Exception as err:
            # The run continues without the recording, and reports it at the end.
            self._fail(err)

    def _write(self, frame: RGBDFrame) -> None:
        if not self.files[-1].exists():
            # Its disk space would not be free until it is closed.
            raise DriverError(f"{self.files[-1]} was deleted or moved")
        if self._began_ns is None or frame.timestamp_ns < self._began_ns:
            self._began_ns = frame.timestamp_ns
        elif frame.timestamp_ns - self._began_ns >= self._split_ns:
            self._writer.close()
            part = part_after(self.path, len(self.files))
            self._writer = self._open_file(part)
            self.files += (part,)
            self._began_ns = frame.timestamp_ns
        self._writer.write(frame)

    def _fail(self, err: Exception) -> None:
        reason = err.strerror if isinstance(err, OSError) and err.strerror else str(err)
        self.failure = f"{self.path}: recording stopped: {reason}"
        discarded = self._queue.discard()
        with self._putting:
            self.lost += discarded + self._in_hand
        _log.error("%s; %d frames are in the file", self.failure, self.frames)

    def finish(self) -> None:
        """Accept no more frames; queued ones are still written."""
        self._queue.close()

    def close(self, timeout_s: float = _DRAIN_S) -> None:
        """Write the queue and finish the file; frames not written in time are lost and counted."""
        self.finish()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            self.lost += self._queue.discard()
            # Only the current frame is left, which a dead disk never finishes.
            self._thread.join(_LAST_FRAME_S)
            if self._thread.is_alive():
                self.failure = self.failure or f"{self.path}: the disk could not store the last frame"
                return
        if self.frames == 0:
            remove_output(self.path)

    def __exit__(self, *exception: object) -> None:
        interrupted = isinstance(exception[1], KeyboardInterrupt)
        self.close(_INTERRUPTED_DRAIN_S if interrupted else _DRAIN_S)
