"""The saved recording, to which every frame is written."""

import time
from pathlib import Path

import rerun as rr

from nurbseg.app.piped_file import PipedFile
from nurbseg.app.view.stream import Item, Opening, Writer
from nurbseg.app.view.viewer import ViewError

#: Longest wait for the disk before the file counts as stuck, seconds.
_STUCK_S = 10.0
#: Time between two flushes, seconds.
_FLUSH_S = 0.5


class FileSink:
    """Saves every frame in a recording.

    For an index, Rerun's memory grows with each frame. Raises ViewError if the file exists or cannot be
    created.
    """

    def __init__(self, path: Path, opening: Opening, *, index: bool = True) -> None:
        self._path = path
        self._stream = opening.stream()
        try:
            # A full disk would leave Rerun stuck for good, in a flush as well as in ending the stream.
            self._file = PipedFile(path)
            with self._file as pipe:
                self._stream.set_sinks(rr.FileSink(pipe, write_footer=index))
        except (RuntimeError, OSError) as err:
            reason = getattr(err, "strerror", None) or err
            raise ViewError(f"{path}: cannot be created: {reason}") from err
        opening.send(self._stream)
        self._writer = Writer(self._stream)
        self._flushed_s = time.monotonic()

    def put(self, item: Item) -> None:
        """Save a frame or a log line; raises ViewError where the disk is full or stuck."""
        self._check()
        self._writer.write(item)
        self.flush_if_due()

    def flush_if_due(self) -> None:
        """Flush from time to time, so that a killed process leaves what it wrote; waits for a slow disk."""
        if time.monotonic() - self._flushed_s > _FLUSH_S:
            self._flush(_STUCK_S)
            self._flushed_s = time.monotonic()

    def close(self, limit_s: float) -> None:
        """Complete the file; raise ViewError if that takes more than `limit_s` seconds."""
        deadline_s = time.monotonic() + limit_s
        self._flush(limit_s)
        self._stream.disconnect()
        if not self._file.join(deadline_s - time.monotonic()):
            raise ViewError(f"{self._path}: not written in time; its last frames are missing")
        self._check()

    def _flush(self, timeout_s: float) -> None:
        try:
            self._stream.flush(timeout_sec=timeout_s)
        except RuntimeError as err:
            raise ViewError(f"{self._path}: cannot be written: {err}") from err

    def _check(self) -> None:
        if self._file.error is not None:
            reason = self._file.error.strerror
            raise ViewError(f"{self._path}: cannot be written: {reason}") from self._file.error
