"""Recordings made during a run: their base class, and those by OpenNI2's own recorder."""

import logging
import shutil
from abc import abstractmethod
from pathlib import Path
from typing import Any

from nurbseg.app.recording.config import RecordConfig
from nurbseg.drivers.closing import Closing
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.reconnect import Reconnecting, Recordable

_log = logging.getLogger(__name__)

#: A longer time between two frames, nanoseconds, is a jump of the clock.
_LONGEST_GAP_NS = 10_000_000_000


def free_space(path: Path) -> int:
    """Return the free space for a file, bytes."""
    return shutil.disk_usage(path.parent).free


class Recording(Closing):
    """Records frames of a run; `path` is the first file.

    Raises DriverError if the disk is too full to begin.
    """

    def __init__(self, path: Path, config: RecordConfig) -> None:
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
        self._last_ns: int | None = None
        if missing := self._shortage():
            least = f"recording stops at {config.space_min_mb} MB (--record-space-min)"
            raise DriverError(f"{path}: {missing}, and {least}")

    @property
    def size_mb(self) -> float:
        """Size of the files now, 10^6 bytes; waits for a disk that does not answer."""
        return round(sum(file.stat().st_size for file in self.files if file.exists()) / 1e6, 1)

    @property
    def behind(self) -> bool:
        """Whether writing is so far behind that nothing else should use the processor."""
        return False

    @property
    @abstractmethod
    def files(self) -> tuple[Path, ...]:
        """The files, in the order of their frames."""

    @property
    def ended(self) -> bool:
        """Whether no more frames are written."""
        return bool(self.failure)

    @property
    @abstractmethod
    def finished(self) -> bool:
        """Whether all frames are written, after `finish` or a failure."""

    @abstractmethod
    def put(self, frame: RGBDFrame) -> None:
        """Record a frame; call from the thread that reads the source."""

    @abstractmethod
    def finish(self) -> None:
        """Accept no more frames; call from the thread that reads the source, also twice."""

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
        if self._first_ns is None:
            self._first_ns = frame.timestamp_ns
        return frame.timestamp_ns - self._first_ns < self._delay_ns

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


class OniRecording(Recording):
    """Starts and stops a camera's recorder to .oni, on the thread that reads the camera.

    With `at_once` (nobody reads the camera yet) and no delay it starts immediately, and raises DriverError if
    it cannot; otherwise with the first frame. `frames` are those read while the recorder was running; none
    are `lost`, because the recorder has its own thread.
    """

    def __init__(self, path: Path, camera: Recordable, config: RecordConfig, *, at_once: bool = True) -> None:
        super().__init__(path, config)
        self._camera = camera
        self._lossy = config.color == "jpeg95"
        self._is_recording = self._is_finished = False
        if at_once and not self._delay_ns:
            self._start()

    @property
    def finished(self) -> bool:
        """Whether all frames are written, after `finish` or a failure."""
        return self._is_finished or self.ended

    @property
    def files(self) -> tuple[Path, ...]:
        """The files; several if the camera was disconnected in between."""
        later = self._camera.recorded_files[1:] if isinstance(self._camera, Reconnecting) else ()
        return (self.path, *later)

    def _start(self) -> None:
        self._camera.start_recording(self.path, lossy=self._lossy)
        self._is_recording = True

    def put(self, frame: RGBDFrame) -> None:
        """Start after the delay, and stop when the disk is nearly full."""
        # Starting the recorder resets the camera's clock.
        if self.failure or (not self._is_recording and self._is_early(frame)):
            return
        try:
            if not self._is_recording:
                self._start()
            reason = self._shortage()
            if not reason and not self.files[-1].exists():
                reason = f"{self.files[-1]} was deleted or moved"
            if reason:
                self._camera.stop_recording()
            elif isinstance(self._camera, Reconnecting):
                reason = self._camera.recording_failure
        except DriverError as err:
            reason = str(err)
        if reason:
            self._fail(reason)
        else:
            self.frames += 1
            self.written_mb = self.size_mb
            self._add_time(frame)

    def _fail(self, reason: str) -> None:
        self._is_recording = False
        self.failure = f"{self.path}: recording stopped: {reason}"
        _log.error("%s", self.failure)

    def finish(self) -> None:
        """Finish the file; call from the thread that reads the camera, also twice."""
        if self._is_recording:
            self._is_recording = False
            try:
                self._camera.stop_recording()
            except DriverError as err:
                self._fail(str(err))
        self._is_finished = True

    def close(self) -> None:
        """Finish the file when nobody reads the camera any more; may be called twice."""
        self.finish()
