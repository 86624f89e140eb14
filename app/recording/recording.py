"""The base class of recordings made during a run."""

import shutil
from abc import abstractmethod
from pathlib import Path
from typing import Any

from nurbseg.app.settings.record_config import RecordConfig
from nurbseg.common.closing import Closing
from nurbseg.common.errors import DriverError
from nurbseg.common.frame import RGBDFrame

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
