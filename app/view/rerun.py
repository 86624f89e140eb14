"""The view with Rerun: its sinks, the process of the viewer or server, and the program's log."""

import logging
import os
import uuid
from pathlib import Path

from nurbseg.app.view.config import bracketed
from nurbseg.app.view.drawing.frame import ViewFrame
from nurbseg.app.view.messages import Line, Open, Opened, Status

# Rerun reports a lost viewer on stderr once for each entity, and a file without an index; we log the former
# once, and the latter is intended.
os.environ.setdefault(
    "RUST_LOG",
    "warn,re_grpc_client=off,re_sdk::recording_stream=off,re_quota_channel=off,re_log_encoding::rrd::file_sink=error",
)

import rerun as rr

from nurbseg.app.view import viewer
from nurbseg.app.view.drawing.blueprint import legend
from nurbseg.app.view.drawing.entities import LEGEND, FrameEntities, markdown, opening_entities
from nurbseg.app.view.file import FileSink
from nurbseg.app.view.live import ViewerSink
from nurbseg.app.view.serving import WebServer
from nurbseg.app.view.stream import Opening

logger = logging.getLogger(__name__)

#: How long the viewer may take for the last frame once the file is complete, seconds.
_VIEWER_CLOSE_S = 0.3


class RerunView:
    """Shows and saves frames; each sink has its own stream of the same recording.

    Runs in the process `nurbseg.app.view.program`. Errors are those of `IsolatedView`.
    """

    def __init__(self, wanted: Open) -> None:
        self._config = config = wanted.config
        self._server: WebServer | None = None
        self._file: FileSink | None = None
        self._viewer: ViewerSink | None = None
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
        try:
            if config.save is not None:
                self._file = FileSink(Path(config.save), opening, index=config.save_index != "off")
            how_to_look = self._open_viewer(opening)
        except BaseException:
            self.close()
            raise
        self.opened = Opened(how_to_look, serving=self._server is not None)

    def status(self) -> Status:
        """Return the numbers of frames that were not shown live, and of connections to a viewer."""
        live = self._viewer
        return Status(0, 0) if live is None else Status(live.queue.dropped, live.connections)

    def show(self, frame: ViewFrame) -> None:
        """Show and save a frame; a slow viewer gets only the newest one, the file gets every one."""
        entities = FrameEntities(frame, self._config)
        for sink in self._sinks:
            sink.put(entities)

    def look_after(self) -> None:
        """Restart the web server if it has ended, and flush the file; call from the thread that made this."""
        if self._server is not None:
            self._server.restart_if_ended()
        if self._file is not None:
            self._file.flush_if_due()

    def show_line(self, line: Line) -> None:
        """Show and save a log line."""
        for sink in self._sinks:
            sink.put(line)

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

    @property
    def _sinks(self) -> list[ViewerSink | FileSink]:
        # The file first: the viewer, on its thread, then finds what is drawn already.
        return [each for each in (self._file, self._viewer) if each is not None]

    def _open_viewer(self, opening: Opening) -> str:
        """Connect to the viewer or open one; return what the user must do to see it."""
        config = self._config
        mode = viewer.chosen_mode(config)
        if mode == "connect":
            self._viewer = ViewerSink(config.viewer_url, opening)
        elif mode == "spawn":
            self._spawn(opening)
        elif mode == "serve":
            self._server = WebServer(config)
            self._viewer = ViewerSink(self._server.url, opening, self._server.is_starting)
            return self._server.page_url
        elif config.save is not None:
            return f"rerun {config.save}"
        return ""

    def _spawn(self, opening: Opening) -> None:
        """Open a viewer's window, or use one that is already open."""
        port = self._config.port or viewer.free_port(self._config.bind)
        host = viewer.reachable(self._config.bind)
        process = None
        if not viewer.listens(host, port):
            if viewer.is_taken(self._config.bind, port):
                raise viewer.ViewError(f"port {port} is in use by another program; choose another port")
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
