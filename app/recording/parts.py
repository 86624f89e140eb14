"""A recording as one file, or as several that follow each other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.files import part_after
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.mcap.writer import RecordingWriter


class PartedWriter:
    """Writes frames to a file, and after some time by their own clock goes on in another, ``NAME-2.mcap``.

    `files` are those begun so far, none of which existed. Raises OSError if the file cannot be made.
    """

    def __init__(
        self, path: Path, open_file: Callable[[Path], RecordingWriter], split_s: float | None = None
    ) -> None:
        self.files: tuple[Path, ...] = (path,)
        self._open_file = open_file
        self._split_ns = None if split_s is None else round(split_s * 1e9)
        self._first_ns: int | None = None
        self._writer = open_file(path)

    def write(self, frame: RGBDFrame) -> None:
        """Add one frame.

        Raises OSError if it cannot be written, or the next file cannot be made; DriverError if the file was
        deleted meanwhile, which the disk would not give back before it is closed.
        """
        if not self.files[-1].exists():
            raise DriverError(f"{self.files[-1]} was deleted or moved")
        if self._first_ns is None:
            self._first_ns = frame.timestamp_ns
        elif self._split_ns is not None and frame.timestamp_ns - self._first_ns >= self._split_ns:
            self._writer.close()
            part = part_after(self.files[0], len(self.files))
            self._writer = self._open_file(part)
            self.files += (part,)
            self._first_ns = frame.timestamp_ns
        self._writer.write(frame)

    def close(self) -> None:
        """Finish the file that is open; an OSError says that it cannot be written."""
        self._writer.close()
