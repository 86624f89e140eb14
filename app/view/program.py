"""The program that shows and saves frames for another process, with Rerun.

It ends on request, or when the other process has ended, after the frames received until then.
"""

import contextlib
import ctypes
import logging
import os
import signal
import threading
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path

# Rerun reports a lost viewer on stderr once for each entity, and a file without an index; we log the former
# once, and the latter is intended.
os.environ.setdefault(
    "RUST_LOG",
    "warn,re_grpc_client=off,re_sdk::recording_stream=off,re_quota_channel=off,re_log_encoding::rrd::file_sink=error",
)

import rerun as rr

from nurbseg.app.control.commands import RunState
from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import bracketed
from nurbseg.app.view import viewer
from nurbseg.app.view.drawing.blueprint import legend
from nurbseg.app.view.drawing.entities import LEGEND, FrameEntities, markdown, opening_entities
from nurbseg.app.view.drawing.frame import ViewFrame
from nurbseg.app.view.live import ViewerSink
from nurbseg.app.view.page.server import WebServer
from nurbseg.app.view.stream import FileSink, NewestSink, Opening
from nurbseg.app.view.view import Asked, Close, Line, Open, State
from nurbseg.app.view.viewer import FILE_PATIENCE_S
from nurbseg.common.closing import closed_on_error
from nurbseg.common.computer import leave_a_core
from nurbseg.common.process.channel import Channel, ChannelClosedError, connect_to_parent, forward_log

logger = logging.getLogger(__name__)

#: Time between two checks of the viewer, seconds.
_POLL_S = 0.1
#: Longest wait for the first message, seconds: the run may wait for its source.
_BEGIN_S = 3600.0
#: Time limit for ending after the other process has ended, seconds.
_END_S = 2.0 * FILE_PATIENCE_S
#: By how much this process is less urgent than the segmentation, which otherwise waits for it on two cores.
_LESS_URGENT = 4
#: Parameter of glibc's `mallopt`: maximum number of heaps.
_M_ARENA_MAX = -8
#: How long the viewer may take for the last frame once the file is complete, seconds.
_VIEWER_CLOSE_S = 0.6


class RerunView:
    """Shows and saves frames; each sink has its own stream of the same recording.

    `ask` gives the run a command, from any thread. Errors are those of `IsolatedView`.
    """

    def __init__(self, wanted: Open, ask: Callable[[str, int], object]) -> None:
        self._ask = ask
        self._config = config = wanted.config
        #: The first thing that could not be shown or saved.
        self.problem = ""
        self._server: WebServer | None = None
        self._file: FileSink | None = None
        self._viewer: NewestSink | None = None
        opening = Opening(
            recording_id=str(uuid.uuid4()),
            name=wanted.name,
            properties={
                subject: rr.AnyValues(drop_untyped_nones=True, **values)
                for subject, values in wanted.properties.items()
            },
            static=(
                *opening_entities(),
                (LEGEND, markdown(legend(config, wanted.segmentation))),
            ),
        )
        with closed_on_error(self.close):
            if config.save is not None:
                self._file = FileSink(Path(config.save), opening, index=config.save_index != "off")
            self._viewer_hint = self._open_viewer(opening)

    def state(self, *, closed: bool = False) -> State:
        """Return what the other process is to know."""
        live = self._viewer
        dropped, connections = (0, 0) if live is None else (live.queue.dropped, live.connections)
        return State(self._viewer_hint, self._server is not None, dropped, connections, self.problem, closed)

    def show(self, message: ViewFrame | Line | RunState) -> None:
        """Show and save a frame, or a log line; a slow viewer gets only the newest, the file every one.

        The state of the run is shown on the page.
        """
        if isinstance(message, RunState):
            if self._server is not None:
                self._server.tell(message)
            return
        item = message if isinstance(message, Line) else FrameEntities(message, self._config)
        # The file first: the viewer, on its thread, then finds what is drawn already.
        for sink in (self._file, self._viewer):
            if sink is not None:
                sink.put(item)

    def poll(self) -> None:
        """Flush the file from time to time."""
        if self._file is not None:
            self._file.flush_if_due()

    def close(self, *, file_limit_s: float = viewer.FILE_CLOSE_S) -> None:
        """Close all sinks within the time, and with the errors, of `IsolatedView.close`."""
        if self._viewer is not None:
            self._viewer.queue.close()
        try:
            if self._file is not None:
                self._file.close(file_limit_s)
        finally:
            if self._viewer is not None:
                self._viewer.finish_close(_VIEWER_CLOSE_S)
            if self._server is not None:
                self._server.close()

    def _open_viewer(self, opening: Opening) -> str:
        """Connect to the viewer or open one; return what the user must do to see it."""
        config = self._config
        mode = viewer.chosen_mode(config)
        if mode == "connect":
            self._viewer = ViewerSink(config.viewer_url, opening)
        elif mode == "spawn":
            self._spawn(opening)
        elif mode == "serve":
            self._server = WebServer(config, opening, self._ask)
            self._viewer = self._server.frames
            return self._server.page_url
        elif config.save is not None:
            return viewer.viewer_command(config.save)
        return ""

    def _spawn(self, opening: Opening) -> None:
        """Open a viewer's window, or use one that is already open."""
        port = self._config.port or viewer.free_port(self._config.bind)
        host = viewer.reachable(self._config.bind)
        process = None
        if not viewer.listens(host, port):
            if viewer.is_taken(self._config.bind, port):
                raise ViewError(f"port {port} is in use by another program; choose another port")
            process = viewer.start_viewer(self._config, port)
            viewer.warn_beyond_loopback(self._config.bind, port)

        logged = False

        def starting() -> bool:
            nonlocal logged
            code = process.poll() if process is not None else None
            if code is not None and not logged:
                logged = True
                logger.warning(
                    "the viewer ended at once (code %d); run 'rerun' to see why, or use --view serve", code
                )
            return process is not None and code is None

        self._viewer = ViewerSink(f"rerun+http://{bracketed(host)}:{port}/proxy", opening, starting)


def _handle_messages(view: RerunView, channel: Channel) -> float:
    """Handle messages until the last one; return the time limit for completing a file, seconds."""
    sent = None
    while True:
        if (state := view.state()) != sent:
            channel.send(state)
            sent = state
        channel.beat()
        message = channel.receive(_POLL_S)
        if isinstance(message, Close):
            return message.file_limit_s
        try:
            if message is not None:
                view.show(message)
            # After the message, which a stuck disk would lose.
            view.poll()
        except ViewError as err:
            view.problem = view.problem or str(err)
        except Exception as err:
            what = f"a frame cannot be shown ({type(err).__name__}): {err}"
            view.problem = view.problem or f"{what}{viewer.untested_rerun()}"


def _ask(channel: Channel, command: str, number: int) -> None:
    """Give a run a command, unless it has ended."""
    with contextlib.suppress(ChannelClosedError):
        channel.send(Asked(command, number))


def _share_one_heap() -> None:
    """Let all threads share one heap: arrays pass between threads, and several heaps would each grow."""
    with contextlib.suppress(OSError, AttributeError):  # Another C library has no such heaps.
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1)


def _run(channel: Channel) -> int:
    message = channel.receive(_BEGIN_S)
    if not isinstance(message, Open):
        return 1
    forward_log(channel, message.log_level)
    try:
        view = RerunView(message, partial(_ask, channel))
    except ViewError as err:
        channel.send(State(problem=str(err)))
        return 1
    limit_s = FILE_PATIENCE_S
    with contextlib.suppress(ChannelClosedError):
        limit_s = _handle_messages(view, channel)
    try:
        view.close(file_limit_s=limit_s)
    except ViewError as err:
        view.problem = view.problem or str(err)
    channel.send(view.state(closed=True))
    return 0


def main() -> int:
    """Show and save what the channel delivers."""
    for number in (signal.SIGINT, signal.SIGTERM):
        # The other process ends this one. Not SIG_IGN, which a viewer started here would inherit.
        signal.signal(number, lambda *_: None)
    os.nice(_LESS_URGENT)
    leave_a_core([threading.current_thread()])
    _share_one_heap()
    try:
        return _run(connect_to_parent(limit_s=_END_S))
    except ChannelClosedError:
        return 0


if __name__ == "__main__":
    # Not sys.exit: a stuck thread of a library would keep the process alive forever.
    os._exit(main())
