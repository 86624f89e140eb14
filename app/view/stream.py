"""Streams of a recording: what they hold of frames and log lines, and the file that all are saved to."""

import contextlib
import errno
import fcntl
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr

from nurbseg.app.errors import ViewError
from nurbseg.app.view.drawing.blueprint import blueprint
from nurbseg.app.view.drawing.entities import LOG, FrameEntities, camera_entities, stage_entities
from nurbseg.app.view.drawing.frame import Moment
from nurbseg.app.view.drawing.tree import Entities
from nurbseg.app.view.view import Line
from nurbseg.common.files import create_private
from nurbseg.common.frame import Calibration
from nurbseg.common.process.bounded_queue import BoundedQueue

APPLICATION = "nurbseg"

#: A device clock past this (the year 2001) is a date; otherwise it counts from an arbitrary start.
_EPOCH_NS = 1_000_000_000 * 10**9


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """How every recording begins.

    All sinks of a run share one `recording_id`, so that a viewer shows one recording. `properties` are by
    subject; `static` holds entity paths with what is valid at all times.
    """

    recording_id: str
    name: str
    properties: Mapping[str, rr.AnyValues]
    static: tuple[tuple[str, rr.AsComponents], ...]

    def stream(self) -> rr.RecordingStream:
        """Return a new stream without a sink."""
        return rr.RecordingStream(APPLICATION, recording_id=self.recording_id)

    def send(self, stream: rr.RecordingStream) -> None:
        """Log this to a stream that has a sink."""
        stream.send_recording_name(self.name)
        for name, values in self.properties.items():
            stream.send_property(name, values)
        log_entities(stream, self.static, static=True)


Item = FrameEntities | Line


def log_entities(stream: rr.RecordingStream, entities: Entities, *, static: bool = False) -> None:
    """Log each entity at its path, at the current time of this thread."""
    for path, entity in entities:
        stream.log(path, entity, static=static)


def set_time(stream: rr.RecordingStream, moment: Moment) -> None:
    """Set the time of what this thread logs next."""
    stream.set_time("frame", sequence=moment.frame)
    if moment.device_ns is None:
        return
    if moment.device_ns > _EPOCH_NS:
        stream.set_time("device_time", timestamp=np.datetime64(moment.device_ns, "ns"))
    else:
        stream.set_time("device_time", duration=np.timedelta64(moment.device_ns, "ns"))


class Writer:
    """Writes items to a stream, and the layout and the cameras, to `lasting` if given, when they change."""

    def __init__(self, lasting: rr.RecordingStream | None = None) -> None:
        self._lasting = lasting
        self._cameras: Calibration | None = None
        self._kind: tuple[bool, bool, bool] | None = None
        self._timeline = "frame"
        self._newest = 0
        self._stages: tuple[str, ...] = ()

    def write(self, stream: rr.RecordingStream, item: Item) -> None:
        """Log a frame or a line at its time; the stream is the same in every call."""
        set_time(stream, item.moment)
        if isinstance(item, Line):
            stream.log(LOG, rr.TextLog(item.text, level=rr.LoggingHandler.LVL2NAME.get(item.level, "INFO")))
            return
        frame, lasting = item.frame, self._lasting or stream
        kind = frame.unregistered_color is None, frame.truth is not None, frame.objects is not None
        went_back = item.moment.frame < self._newest and self._timeline == "frame"
        self._newest = max(self._newest, item.moment.frame)
        if went_back:
            # A viewer follows the highest frame number, which is no longer the newest frame.
            self._timeline = "log_time"
        if kind != self._kind or went_back:
            self._kind = kind
            lasting.send_blueprint(blueprint(frame, item.view, self._timeline))
        if self._cameras is None or not frame.calibration.equals(self._cameras):
            self._cameras = frame.calibration
            log_entities(lasting, camera_entities(frame.calibration), static=True)
        if (stages := tuple(frame.elapsed_ms)) != self._stages:
            self._stages = stages
            log_entities(lasting, stage_entities(stages), static=True)
        log_entities(stream, item.entities)


class NewestSink(ABC):
    """Shows the newest frames, in a thread of its own: whoever puts them never waits.

    Attributes
    ----------
    queue : BoundedQueue
        Items that wait; a newer frame replaces one that waits.
    connections : int
        Number of viewers so far.
    """

    def __init__(self, name: str) -> None:
        self.connections = 0
        self.queue: BoundedQueue[Item] = BoundedQueue(1, "drop oldest")
        # A daemon, because Rerun can block for good.
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Show a frame, for which one that still waits is dropped, or a log line."""
        if isinstance(item, FrameEntities):
            self.queue.put(item)
        else:
            self.queue.put_urgent(item)

    def finish_close(self, limit_s: float) -> None:
        """Give viewers so many seconds to take what is queued."""
        self._thread.join(limit_s)

    @abstractmethod
    def _run(self) -> None: ...


#: Longest wait for the disk before the file counts as stuck, seconds.
_STUCK_S = 10.0
#: Time between two flushes, seconds.
_FLUSH_S = 0.5


#: Size of a read, and of the pipe, bytes.
_PART = 1 << 20


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
        self._writer = Writer()
        self._flushed_s = time.monotonic()

    def put(self, item: Item) -> None:
        """Save a frame or a log line; raises ViewError where the disk is full or stuck."""
        self._check()
        self._writer.write(self._stream, item)
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


class PipedFile:
    """A file behind a pipe, whose content goes to the file, or nowhere after an error.

    Some libraries hang forever if a file cannot be written. This pipe is always read to its end. Open it for
    writing within the ``with`` block; the file ends when the last writer has closed the pipe.

    The file must not exist; its folder is created, and only this user may read it. Raises OSError if it
    cannot be created. `error` is the reason why it could not be written any further.
    """

    def __init__(self, path: Path) -> None:
        self.error: OSError | None = None
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = create_private(path, buffering=0)
        self._read_end, self._write_end = os.pipe()
        with contextlib.suppress(OSError):
            # Otherwise a writer would wait after every 64 kB.
            fcntl.fcntl(self._write_end, fcntl.F_SETPIPE_SZ, _PART)
        self._thread = threading.Thread(target=self._copy, name=f"view-file-{path.name}")
        self._thread.start()

    def __enter__(self) -> Path:
        """Return a path by which the pipe can be opened for writing."""
        return Path(f"/proc/self/fd/{self._write_end}")

    def __exit__(self, *_: object) -> None:
        os.close(self._write_end)

    def join(self, timeout_s: float) -> bool:
        """Wait for the end of the file; return whether it came within `timeout_s` seconds."""
        self._thread.join(max(0.0, timeout_s))
        return not self._thread.is_alive()

    def _copy(self) -> None:
        while part := memoryview(os.read(self._read_end, _PART)):
            try:
                if self.error is None and os.fstat(self._file.fileno()).st_nlink == 0:
                    raise OSError(errno.ENOENT, "it was deleted while it was written")
                while part and self.error is None:
                    part = part[self._file.write(part) :]
            except OSError as err:
                self.error = err
        os.close(self._read_end)
        try:
            self._file.close()
        except OSError as err:
            self.error = self.error or err
