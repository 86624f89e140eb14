"""What every recording that is made while a run goes on has in common."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any

from nurbseg.app.recording import disk_space
from nurbseg.app.recording.config import RecordConfig
from nurbseg.drivers.closing import Closing
from nurbseg.drivers.frame import RGBDFrame

#: A longer time between two frames is a jump of the clock, nanoseconds.
_LONGEST_GAP_NS = 10_000_000_000


class Recording(Closing):
    """Takes the frames of a run, from the moment at which it begins.

    `path` is the first file; `frames` are in the files, and those `lost` were to be in them and are not.
    `seconds` is the length of what was to be in the files, by the frames' own clock. `failure` says why the
    recording ended before the run did, and is empty where it did not. `size_mb` and `room_mb` say how large
    the files are, and may still become together, in units of 10^6 bytes, as of the last frame.
    """

    def __init__(self, path: Path, config: RecordConfig) -> None:
        self.path = path
        self.frames = self.lost = 0
        self.failure = ""
        self.size_mb = self.room_mb = 0.0
        self._delay_ns = round(config.delay_s * 1e9)
        self._space_min_mb = config.space_min_mb
        self._first_ns: int | None = None
        self.seconds = 0.0
        self._last_ns: int | None = None

    @property
    def behind(self) -> bool:
        """Whether so much waits to be written that nothing else should use the processor."""
        return False

    @property
    @abstractmethod
    def files(self) -> tuple[Path, ...]:
        """The files, in the order of their frames."""

    @property
    @abstractmethod
    def ended(self) -> bool:
        """Whether nothing more is written."""

    @property
    @abstractmethod
    def finished(self) -> bool:
        """Whether what came is written, after `finish` or a failure."""

    @abstractmethod
    def put(self, frame: RGBDFrame) -> None:
        """Have a frame written; for the thread that reads."""

    @abstractmethod
    def finish(self) -> None:
        """Say that no frame follows; for the thread that reads, and safe to call twice."""

    def figures(self) -> dict[str, Any]:
        """Return what the run's report says of the recording."""
        files = self.files
        return {
            "file": str(self.path),
            "files": [str(file) for file in files],
            "frames": self.frames,
            "lost": self.lost,
            "megabytes": disk_space.megabytes(files),
            "failure": self.failure,
        }

    def _is_early(self, frame: RGBDFrame) -> bool:
        """Say whether a frame is of the first seconds, by its own clock, that are not to be recorded."""
        if self._first_ns is None:
            self._first_ns = frame.timestamp_ns
        return frame.timestamp_ns - self._first_ns < self._delay_ns

    def _add_time(self, frame: RGBDFrame) -> None:
        """Count the time since the frame before, by their own clock, which restarts when a camera does."""
        if self._last_ns is not None and 0 < frame.timestamp_ns - self._last_ns < _LONGEST_GAP_NS:
            self.seconds += (frame.timestamp_ns - self._last_ns) / 1e9
        self._last_ns = frame.timestamp_ns

    def _shortage(self) -> str:
        """Say that too little space is left, or nothing; for the thread that may wait for the disk."""
        free_bytes = disk_space.free_space(self.files[-1])
        self.size_mb = disk_space.megabytes(self.files)
        self.room_mb = max(0.0, free_bytes / 1e6 - self._space_min_mb)
        return disk_space.shortage(free_bytes, self._space_min_mb)
