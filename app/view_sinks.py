"""Where the entities go, each sink in a thread of its own: a file that loses nothing, a viewer that may."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from nurbseg.app.outbox import Outbox
from nurbseg.app.view_blueprint import blueprint
from nurbseg.app.view_config import viewer_address
from nurbseg.app.view_entities import LOG, Entities, FrameEntities, Moment, camera_entities, stage_entities
from nurbseg.app.viewer_process import ViewError, cut_connections, listens
from nurbseg.drivers.frame import Calibration

logger = logging.getLogger(__name__)

APPLICATION = "nurbseg"
#: Frames that wait for the file: a second of a slow disk.
_FILE_FRAMES = 8
#: Longest wait for room before the file counts as stuck, longest wait of a flush, seconds.
_FILE_TIMEOUT_S = 10.0
#: How often what was logged is forced into the file.
_FLUSH_S = 0.5
#: How long a viewer is waited for before the stop signal is looked at again, and before we say so.
_POLL_S, _POLL_MAX_S, _PATIENCE_S = 0.2, 5.0, 3.0
#: Pause between two attempts to reach a viewer.
RETRY_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """What every recording begins with.

    Parameters
    ----------
    recording_id : str
        The same for all sinks of a run, so that a viewer takes what they hold for one recording.
    name : str
        What the recording is called.
    properties : mapping of str to entity
        Of the device, the configuration and the versions.
    static : sequence of (path, entity)
        What holds at all times.
    """

    recording_id: str
    name: str
    properties: Mapping[str, rr.AnyValues]
    static: tuple[tuple[str, rr.AsComponents], ...]

    def stream(self) -> rr.RecordingStream:
        """Return a new stream, still without a sink."""
        return rr.RecordingStream(APPLICATION, recording_id=self.recording_id)

    def send(self, stream: rr.RecordingStream) -> None:
        """Log it to a stream that has its sink."""
        stream.send_recording_name(self.name)
        for name, values in self.properties.items():
            stream.send_property(name, values)
        _log(stream, self.static, static=True)


@dataclass(frozen=True, slots=True, eq=False)
class LogLine:
    """One line of the program's log.

    Parameters
    ----------
    moment : Moment
        The frame at which it was said.
    level, text : str
        Rerun's name of the severity, and the message.
    """

    moment: Moment
    level: str
    text: str


Item = FrameEntities | LogLine


def _log(stream: rr.RecordingStream, entities: Entities, *, static: bool = False) -> None:
    for path, entity in entities:
        stream.log(path, entity, static=static)


class _Writer:
    """Writes items to one stream; first the layout for their kind, and the cameras when they change."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._calibration: Calibration | None = None
        self._stages: tuple[str, ...] = ()

    def write(self, item: Item) -> None:
        item.moment.set_on(self._stream)
        if isinstance(item, LogLine):
            self._stream.log(LOG, rr.TextLog(item.text, level=item.level))
            return
        if self._calibration is None:
            frame = item.result.frame
            self._stream.send_blueprint(
                blueprint(registered=frame.calibration.is_registered, ground_truth=frame.labels is not None)
            )
        if item.calibration is not self._calibration:
            self._calibration = item.calibration
            _log(self._stream, camera_entities(item.calibration), static=True)
        if item.stages != self._stages:
            self._stages = item.stages
            _log(self._stream, stage_entities(item.stages), static=True)
        _log(self._stream, item.entities())


class FileSink:
    """Saves a recording; every frame that it is given is in the file.

    Parameters
    ----------
    path : Path
        The .rrd file; overwritten.
    opening : Opening
        What it begins with.

    Raises
    ------
    ViewError
        If the file cannot be created.
    """

    def __init__(self, path: Path, opening: Opening) -> None:
        self._path = path
        self._outbox: Outbox[Item] = Outbox(_FILE_FRAMES, lossless=True)
        self._error: BaseException | None = None
        self._stream = opening.stream()
        try:
            self._stream.set_sinks(rr.FileSink(path))
        except (RuntimeError, OSError) as err:
            raise ViewError(f"{path}: cannot be created: {err}") from err
        self._thread = threading.Thread(target=self._run, args=(opening,), name=f"view-file-{path.name}")
        self._thread.start()

    def put(self, frame: FrameEntities) -> None:
        """Save a frame; waits where the disk is slow.

        Raises
        ------
        ViewError
            If the file can no longer be written.
        """
        self._check()
        try:
            self._outbox.put(frame, _FILE_TIMEOUT_S)
        except TimeoutError:
            raise ViewError(f"{self._path}: took no frame for {_FILE_TIMEOUT_S:g} s") from None
        self._check()

    def put_line(self, line: LogLine) -> None:
        """Save a line of the log; never waits."""
        self._outbox.put_line(line)

    def begin_close(self) -> None:
        """Accept nothing more."""
        self._outbox.close()

    def finish_close(self, deadline_s: float) -> None:
        """Wait until the file is whole.

        Parameters
        ----------
        deadline_s : float
            Monotonic time of the end of the wait.

        Raises
        ------
        ViewError
            If the file is not whole.
        """
        self._thread.join(max(0.0, deadline_s - time.monotonic()))
        if self._thread.is_alive():
            raise ViewError(f"{self._path}: not written in time; its last frames are missing")
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise ViewError(f"{self._path}: cannot be written: {self._error}") from self._error

    def _run(self, opening: Opening) -> None:
        try:
            opening.send(self._stream)
            writer = _Writer(self._stream)
            flushed_s = time.monotonic()
            while not self._outbox.finished:
                for item in self._outbox.take(timeout_s=_FLUSH_S):
                    writer.write(item)
                if time.monotonic() - flushed_s > _FLUSH_S:
                    # So that a full disk is found out, and a killed process leaves what it wrote.
                    self._stream.flush(timeout_sec=_FILE_TIMEOUT_S)
                    flushed_s = time.monotonic()
            self._stream.flush(timeout_sec=_FILE_TIMEOUT_S)
        except Exception as err:
            self._error = err
            self._outbox.close()
        finally:
            self._stream.disconnect()


class ViewerSink:
    """Shows the newest frames in a viewer, for as long as there is one; never makes anybody wait.

    At most one frame is on its way: the next is logged when the viewer's side took the one before.
    Without that bound Rerun would block in `log` for as long as a viewer is frozen.

    Parameters
    ----------
    url : str
        The viewer, ``rerun+http://HOST:PORT/proxy``.
    opening : Opening
        What each connection begins with.
    starting : callable, optional
        Returns whether a viewer is being started, which is then waited for without a word.
    """

    def __init__(self, url: str, opening: Opening, starting: Callable[[], bool] = lambda: False) -> None:
        self._url = url
        self._address = viewer_address(url)
        self._opening = opening
        self._starting = starting
        self._absence_said = False
        self._connections = 0
        self._outbox: Outbox[Item] = Outbox(1, lossless=False)
        self._stopping = threading.Event()
        self._connected = threading.Event()
        # A daemon, because Rerun can block for good.
        self._thread = threading.Thread(target=self._run, name="view-live", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """Frames that the viewer was too slow or too absent for."""
        return self._outbox.dropped

    @property
    def connections(self) -> int:
        """How often a viewer was connected to."""
        return self._connections

    def wait_connected(self, timeout_s: float) -> bool:
        """Wait for a viewer; return whether there is one."""
        return self._connected.wait(timeout_s)

    def put(self, frame: FrameEntities) -> None:
        """Show a frame, or drop an older one that still waits."""
        self._outbox.put(frame, 0.0)

    def put_line(self, line: LogLine) -> None:
        """Show a line of the log."""
        self._outbox.put_line(line)

    def begin_close(self) -> None:
        """Accept nothing more."""
        self._outbox.close()

    def finish_close(self, deadline_s: float) -> None:
        """Give the viewer until `deadline_s` (monotonic) to take what waits, then let go of it."""
        self._thread.join(max(0.0, deadline_s - time.monotonic()))
        self._stopping.set()
        self._thread.join(1.5 * _POLL_S)
        if self._thread.is_alive():
            cut_connections(*self._address)
            self._thread.join(_POLL_S)

    def _run(self) -> None:
        try:
            while not self._stopping.is_set() and not self._outbox.finished:
                if listens(*self._address):
                    self._serve()
                elif not self._may_come():
                    return
                else:
                    self._stopping.wait(RETRY_S)
        except Exception:
            logger.exception("nothing more is shown in the viewer at %s", self._url)

    def _may_come(self) -> bool:
        """Whether to go on waiting for a viewer that does not listen."""
        if self._connected.is_set():
            return not self._outbox.closed
        if self._starting():
            return True
        if not self._absence_said:
            self._absence_said = True
            logger.warning("no viewer listens at %s; it is shown to as soon as one does", self._url)
        return not self._outbox.closed

    def _serve(self) -> None:
        """Feed one viewer until it is gone or we stop."""
        stream = self._opening.stream()
        taken = False
        try:
            stream.set_sinks(rr.GrpcSink(self._url))
            self._opening.send(stream)
            taken = self._taken(stream)
            if taken:
                logger.info("showing in the viewer at %s", self._url)
                self._connections += 1
                self._connected.set()
            writer = _Writer(stream)
            while taken and not self._stopping.is_set() and not self._outbox.finished:
                for item in self._outbox.take(timeout_s=1.0):
                    writer.write(item)
                taken = self._taken(stream)
            if not taken and not self._stopping.is_set():
                logger.warning("the viewer at %s is gone; if it comes back it is shown to again", self._url)
        finally:
            if not taken:
                cut_connections(*self._address)
            stream.disconnect()

    def _taken(self, stream: rr.RecordingStream) -> bool:
        """Wait until the viewer's side took everything; return False if it is gone or we stop."""
        began_s = time.monotonic()
        timeout_s = _POLL_S
        said = False
        while not self._stopping.is_set():
            try:
                stream.flush(timeout_sec=timeout_s)
            except RuntimeError as err:
                if "timed out" not in str(err):
                    return False
                # Each flush that timed out stays in Rerun's queue: ask ever less often.
                timeout_s = min(2.0 * timeout_s, _POLL_MAX_S)
            else:
                if said:
                    logger.info("the viewer at %s takes frames again", self._url)
                return True
            if not said and time.monotonic() - began_s > _PATIENCE_S:
                said = True
                logger.warning("the viewer at %s takes nothing; frames are not shown for now", self._url)
        return False


__all__ = ["APPLICATION", "FileSink", "LogLine", "Opening", "ViewerSink"]
