"""The saved recording: a thread writes every frame to a file."""

import contextlib
import threading
import time
from collections.abc import Callable
from pathlib import Path

import rerun as rr

from nurbseg.app.piped_file import PipedFile
from nurbseg.app.view.drawing.entities import FrameEntities
from nurbseg.app.view.stream import Item, Opening, Writer
from nurbseg.app.view.viewer import ViewError
from nurbseg.drivers.process.bounded_queue import BoundedQueue

#: Frames that may be queued: enough for a disk that is slow for a second.
_FRAMES = 8
#: Longest wait for room before the file counts as stuck, longest wait of a flush, seconds.
_TIMEOUT_S = 10.0
#: Time between two flushes, seconds.
_FLUSH_S = 0.5
#: Time between two checks for progress, seconds.
_LOOK_S = 0.1


class FileSink:
    """Saves every frame in a recording.

    For an index, Rerun's memory grows with each frame. Raises ViewError if the file exists or cannot be
    created.
    """

    def __init__(self, path: Path, opening: Opening, *, index: bool = True) -> None:
        self._path = path
        self.queue: BoundedQueue[Item] = BoundedQueue(_FRAMES, "wait")
        self._error: BaseException | None = None
        self._written = 0
        self._stream = opening.stream()
        try:
            # A full disk would leave Rerun stuck for good, in a flush as well as in ending the stream.
            self._file = PipedFile(path)
            with self._file as pipe:
                self._stream.set_sinks(rr.FileSink(pipe, write_footer=index))
        except (RuntimeError, OSError) as err:
            reason = getattr(err, "strerror", None) or err
            raise ViewError(f"{path}: cannot be created: {reason}") from err
        self._thread = threading.Thread(target=self._run, args=(opening,), name=f"view-file-{path.name}")
        self._thread.start()

    def put(self, frame: FrameEntities) -> None:
        """Save a frame; waits where the disk is slow, and raises ViewError where the file is stuck."""
        self._check()
        try:
            self.queue.put(frame, _TIMEOUT_S)
        except TimeoutError:
            raise ViewError(f"{self._path}: took no frame for {_TIMEOUT_S:g} s") from None
        self._check()

    def finish_close(self, limit_s: float, on_progress: Callable[[], None] = lambda: None) -> None:
        """Wait until the file is complete; raise ViewError if nothing is written for `limit_s` seconds.

        `on_progress` is called from time to time while something is written.
        """
        written, deadline_s = self._written, time.monotonic() + limit_s
        while self._thread.is_alive() and time.monotonic() < deadline_s:
            self._thread.join(_LOOK_S)
            if self._written != written:
                written, deadline_s = self._written, time.monotonic() + limit_s
                on_progress()
        if not self._file.join(deadline_s - time.monotonic()):
            self._check()
            raise ViewError(f"{self._path}: not written in time; its last frames are missing")
        self._check()

    def _check(self) -> None:
        if self._file.error is not None:
            reason = self._file.error.strerror
            raise ViewError(f"{self._path}: cannot be written: {reason}") from self._file.error
        if self._error is None:
            return
        # Rerun reports a stuck disk as RuntimeError; anything else is a frame that could not be drawn.
        trouble = isinstance(self._error, OSError | RuntimeError)
        problem = (
            "cannot be written" if trouble else f"a frame cannot be shown ({type(self._error).__name__})"
        )
        raise ViewError(f"{self._path}: {problem}: {self._error}") from self._error

    def _run(self, opening: Opening) -> None:
        try:
            opening.send(self._stream)
            writer = Writer(self._stream)
            flushed_s = time.monotonic()
            while not self.queue.finished:
                with contextlib.suppress(TimeoutError):
                    if (item := self.queue.take(_FLUSH_S)) is not None:
                        writer.write(item)
                        self._written += 1
                if time.monotonic() - flushed_s > _FLUSH_S:
                    # So that a killed process leaves what it wrote.
                    self._stream.flush(timeout_sec=_TIMEOUT_S)
                    flushed_s = time.monotonic()
            self._stream.flush(timeout_sec=_TIMEOUT_S)
            self._written += 1
        except Exception as err:
            self._error = err
            self.queue.close()
        finally:
            self._stream.disconnect()
