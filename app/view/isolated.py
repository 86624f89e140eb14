"""A view that shows and saves frames in another process."""

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from operator import attrgetter
from typing import Any

from nurbseg.app.control.commands import RunState
from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.frame import Moment, ViewFrame
from nurbseg.app.view.view import Asked, Close, Line, Open, State, View
from nurbseg.app.view.viewer import FILE_CLOSE_S, FILE_PATIENCE_S, untested_rerun
from nurbseg.common.closing import closed_on_error
from nurbseg.common.computer import versions
from nurbseg.common.errors import in_utf8
from nurbseg.common.process.bounded_queue import BoundedQueue
from nurbseg.common.process.channel import ChannelClosedError
from nurbseg.common.process.child import ChildProcess
from nurbseg.common.settings import setting_paths
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.config import SegmentationConfig

_log = logging.getLogger(__name__)
_package_log = logging.getLogger("nurbseg")

#: Frames that may wait to be sent when every one is saved.
_WAITING = 2
#: Frames in shared memory, one written while another is read, and the largest, bytes.
_SLOTS, _FRAME_BYTES = 2, 1 << 28
#: Time limit for the start of the process, which imports Rerun first, seconds.
_OPEN_S = 60.0
#: Longest wait for room in the queue, seconds; the process itself reports a stuck file after 10 s.
_STUCK_S = 15.0
#: Time limit for closing everything but the file, seconds.
_REST_S = 0.7
#: Time limit for drawing the first frame, seconds; compiling for the first time takes half a minute.
_COMPILE_S = 120.0
#: Time limit for closing while the process still writes, seconds.
_BUSY_S = 10.0
#: Time that the process has to end before it is killed, seconds.
_END_S = 0.2
#: Time between two checks of a process that is slow or has to end, and of an idle one, seconds.
_POLL_S, _IDLE_S = 0.02, 1.0
#: Least time between two frames of a live run that are shown in full, seconds: no table is read faster.
_IN_FULL_S = 0.1
#: Frames over which the frame rate is averaged.
_RATE_FRAMES = 10


class IsolatedView(View):
    """Shows and saves frames with `nurbseg.app.view.program.RerunView` in another process.

    A thread draws and sends frames, another one receives. If a file is saved, it gets every frame, and `show`
    waits while the process is behind; otherwise the oldest queued frame is dropped.

    `process` comes from `begin_view` and ends with this view. The recording is called `name` and contains the
    settings of the segmentation and the device's metadata; the package's log is shown, too. `ask` is given
    the commands of the page. Raises ViewError if the file cannot be created, a port is in use, or the viewer
    cannot be started.
    """

    shows = True

    def __init__(
        self,
        process: ChildProcess,
        config: ViewConfig,
        segmentation: SegmentationConfig,
        metadata: Mapping[str, str],
        name: str,
        is_outlived: Callable[[], bool] = lambda: False,
        ask: Callable[[str, int], object] = lambda *_: None,
    ) -> None:
        super().__init__(is_outlived=is_outlived)
        self._process = process
        self._config = config
        self._channel = process.channel
        self._channel.begin_ring(_SLOTS, _FRAME_BYTES)
        # Every frame is saved, but only the newest is shown.
        self._queue: BoundedQueue[partial[ViewFrame] | Line] = (
            BoundedQueue(1, "drop oldest") if config.save is None else BoundedQueue(_WAITING, "wait")
        )
        #: Set unless a frame is drawn, or none was yet; and when nothing more comes from the process.
        self._drawn, self._ended = threading.Event(), threading.Event()
        self._problem = ""
        self._closed = self._outlived = False
        self._ask = ask
        self._state = State()
        self._shown_s: deque[float] = deque(maxlen=_RATE_FRAMES + 1)
        self._in_full_s = float("-inf")
        self._moment = Moment(0, None)
        self._file_limit_s = FILE_CLOSE_S
        with closed_on_error(process.close):
            self._open(segmentation, metadata, name)
        # A daemon: a program that never closes the view still ends, which closes the file.
        self._threads = [
            threading.Thread(target=each, name=name, daemon=True)
            for name, each in (("view", self._draw), ("view-messages", self._receive))
        ]
        for thread in self._threads:
            thread.start()
        self._handler = _LogHandler(self)
        _package_log.addHandler(self._handler)

    @property
    def dropped(self) -> int:
        """Frames that were not shown live because the viewer was slow, frozen or absent."""
        return self._queue.dropped + self._state.dropped

    @property
    def connections(self) -> int:
        """Number of connections to a viewer so far."""
        return self._state.connections

    def peak_memory_mb(self) -> float:
        """Return the peak resident memory of the process, 10^6 bytes; 0 if unknown."""
        return self._process.peak_memory_mb()

    def show(self, result: FrameResult) -> None:
        """Show and save a frame; a slow viewer gets only the newest one, the file gets every one.

        Raises ViewError if the file can no longer be written, or the process has ended; where the run
        outlives that, it is logged instead.
        """
        if self._closed:
            raise ViewError("the view is closed")
        self._outlived = self.is_outlived()
        try:
            self._check()
            if not self.failure:
                self._show(result)
                self._check()
        except ViewError as err:
            if not self._outlived:
                raise
            if not self.failure:
                self._fail(str(err))
                self.failure, self.serving = self._problem, False
                _log.error("%s; nothing more is shown or saved, but the run goes on", self.failure)

    def _show(self, result: FrameResult) -> None:
        frame = result.frame
        self._moment = Moment(frame.index, frame.timestamp_ns)
        now_s = time.monotonic()
        self._shown_s.append(now_s)
        rate_hz = (len(self._shown_s) - 1) / max(now_s - self._shown_s[0], 1e-6)
        in_full = self.every_frame_in_full or now_s - self._in_full_s >= _IN_FULL_S
        self._in_full_s = now_s if in_full else self._in_full_s
        draw = partial(drawn, result, self._config, result.config.metric, rate_hz=rate_hz, in_full=in_full)
        try:
            self._queue.put(draw, _STUCK_S)
        except TimeoutError:
            raise ViewError(f"{self._config.save}: took no frame for {_STUCK_S:g} s") from None

    def show_line(self, level: int, text: str) -> None:
        """Show a log line; callable from any thread, never waits."""
        self._queue.put_urgent(Line(self._moment, level, text))

    def tell(self, state: RunState) -> None:
        """Show the state of the run on the page, if one is served; never waits."""
        if self.serving:
            with contextlib.suppress(ChannelClosedError):  # which `_receive` reports
                self._channel.send(state, 0.0)

    def close(self, *, file_limit_s: float = FILE_CLOSE_S) -> None:
        """Close within 2 s, or 10 s while the file grows; a viewer's window stays open.

        A ``with`` block that ends without an exception waits longer for a slow disk. Raises ViewError if the
        file is incomplete, or if nothing was shown any more in a run that did nothing else.
        """
        if self._closed:
            return
        self._closed = True
        _package_log.removeHandler(self._handler)
        self._file_limit_s = file_limit_s
        self._queue.close()
        if not self._wait_for_end(file_limit_s) and self._config.save is not None:
            self._fail(f"{self._config.save}: not written in time; its last frames are missing")
        self._ended.set()
        self._process.end(_END_S)
        # It ends at once, unless it waits for the compiler.
        for thread in self._threads:
            thread.join(_COMPILE_S)
        self._process.close()
        # What is recorded or exported instead is whole: a picture that nobody could see is no loss.
        if self._config.save is not None or not self._outlived:
            self._check()

    def __exit__(self, *exception: object) -> None:
        self.close(file_limit_s=FILE_CLOSE_S if any(exception) else FILE_PATIENCE_S)

    def _wait_for_end(self, file_limit_s: float) -> bool:
        """Return whether everything was written in time."""
        is_patient = file_limit_s >= FILE_PATIENCE_S
        limit_s = file_limit_s + _REST_S
        most_s = _COMPILE_S if is_patient else max(limit_s, _BUSY_S)
        closed_s = began_s = time.monotonic()
        while not self._ended.is_set():
            now_s = time.monotonic()
            if is_patient and self._shown_s and not self._drawn.is_set() and now_s - closed_s < _COMPILE_S:
                # In the first run on a computer, drawing waits for the compiler, and the process for frames.
                began_s = now_s
            waited_s = now_s - began_s
            if min(waited_s, self._channel.silent_s) >= limit_s or waited_s >= most_s:
                return False
            self._ended.wait(_POLL_S)
        return True

    def _check(self) -> None:
        if self._problem:
            raise ViewError(self._problem)

    def _fail(self, problem: str) -> None:
        """Remember the first problem, and accept nothing more."""
        self._problem = self._problem or problem
        self._queue.close()

    def _open(self, segmentation: SegmentationConfig, metadata: Mapping[str, str], name: str) -> None:
        properties = _properties(self._config, segmentation, metadata)
        level = _package_log.getEffectiveLevel()
        deadline_s = time.monotonic() + _OPEN_S
        try:
            self._channel.send(Open(self._config, segmentation, properties, in_utf8(name), level))
            while (left_s := deadline_s - time.monotonic()) > 0:
                message = self._channel.receive(left_s)
                if isinstance(message, State):
                    self._handle(message)
                    self._check()
                    self.viewer_hint, self.serving = message.viewer_hint, message.serving
                    return
        except ChannelClosedError:
            raise ViewError(f"the view process {self._process.ending(_END_S)}{untested_rerun()}") from None
        raise ViewError(f"the view process did not start within {_OPEN_S:g} s")

    def _draw(self) -> None:
        """Draw and send what is queued, then ask the process to end."""
        with contextlib.suppress(ChannelClosedError):  # which `_receive` reports
            for item in self._queue:
                if not self._problem:
                    self._send_item(item)
            self._channel.put(Close(self._file_limit_s), _STUCK_S)

    def _receive(self) -> None:
        """Handle the messages of the process until it ends."""
        try:
            while not self._ended.is_set():
                self._handle(self._channel.receive(_IDLE_S))
        except ChannelClosedError:
            if not self._ended.is_set():
                self._fail(f"the view process {self._process.ending(_END_S)}")
        self._drawn.set()
        self._ended.set()

    def _send_item(self, item: partial[ViewFrame] | Line) -> None:
        try:
            if isinstance(item, Line):
                self._channel.send(item)
                return
            self._drawn.clear()
            frame = item()
            self._drawn.set()
            while not self._ended.is_set() and not self._channel.put(frame, _POLL_S):
                pass  # Until the process has taken a frame before.
        except ChannelClosedError:
            raise
        except Exception as err:
            what = f"{self._config.save}: " if self._config.save else ""
            self._fail(f"{what}a frame cannot be shown ({type(err).__name__}): {err}")

    def _handle(self, message: Any) -> None:
        if isinstance(message, Asked):
            self._ask(message.command, message.number)
        elif isinstance(message, State):
            self._state = message
            if message.problem:
                self._fail(message.problem)
            if message.closed:
                self._ended.set()


def _properties(
    config: ViewConfig, segmentation: SegmentationConfig, metadata: Mapping[str, str]
) -> dict[str, dict[str, str]]:
    """Return what is stored with a recording, by subject, as text."""
    settings = {
        field.name: attrgetter(path)(segmentation) for path, field in setting_paths(type(segmentation))
    }
    properties: dict[str, Mapping[str, Any]] = {
        "segmentation": settings,
        "view": {key: value for key, value in asdict(config).items() if value is not None},
        "versions": versions(),
    }
    if metadata:
        properties["device"] = metadata
    # As text: Rerun allows one type per name, and a device's names and values are arbitrary.
    return {
        name: {key: in_utf8(str(value)) for key, value in each.items()} for name, each in properties.items()
    }


class _LogHandler(logging.Handler):
    """Shows the program's log."""

    def __init__(self, view: IsolatedView) -> None:
        super().__init__()
        self._view = view

    def emit(self, record: logging.LogRecord) -> None:
        self._view.show_line(record.levelno, in_utf8(record.getMessage()))
