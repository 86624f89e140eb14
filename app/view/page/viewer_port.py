"""The HTTP server of Rerun's web viewer: its files for everyone, the frames for the page's users."""

import http.client
import re
import secrets
import select
import subprocess
import time
from collections.abc import Mapping
from http import HTTPStatus
from typing import NamedTuple

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig
from nurbseg.app.view import viewer
from nurbseg.app.view.page.door import DoorHandler
from nurbseg.app.view.page.frames import END, GRPC_WEB, READ_MESSAGES, FrameStream

_LOOPBACK = "127.0.0.1"
#: Longest wait for Rerun's own server, and pause between two tries, seconds.
_START_S, _PAUSE_S = 10.0, 0.02
#: Longest time that a browser may take no frames, and time between two checks that it is there, seconds.
_STALL_S, _LOOK_S = 600.0, 5.0
#: Longest request for frames, bytes.
_REQUEST_BYTES_MAX = 1000
#: Links to fonts of other hosts, and to hosts that a browser would connect to in advance.
_FOREIGN_LINK = re.compile(rb'<link\b[^>]*href="https?://[^>]*>')
_PATHS = ("/", "/favicon.ico", "/re_viewer.js", "/re_viewer_bg.wasm", "/sw.js")


class File(NamedTuple):
    """A file of the web viewer."""

    kind: str
    content: bytes


def viewer_files() -> dict[str, File]:
    """Return the files of Rerun's web viewer by path, from its own server, which then ends.

    Raises ViewError if the server cannot be started or does not answer.
    """
    port, web_port = viewer.free_port(_LOOPBACK), viewer.free_port(_LOOPBACK)
    process = viewer.start_web_server(ViewConfig(), port, web_port)
    try:
        return {path: _fetched(process, web_port, path) for path in _PATHS}
    finally:
        process.kill()
        process.wait(_START_S)


def _fetched(process: subprocess.Popen[bytes], port: int, path: str) -> File:
    deadline_s = time.monotonic() + _START_S
    while True:
        connection = http.client.HTTPConnection(_LOOPBACK, port, timeout=_START_S)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            content = _FOREIGN_LINK.sub(b"", answer.read()) if path == "/" else answer.read()
            return File(answer.headers["Content-Type"] or "", content)
        except (OSError, http.client.HTTPException) as err:
            if time.monotonic() > deadline_s or process.poll() is not None:
                raise ViewError(f"Rerun's web viewer cannot be read: {err}{viewer.untested_rerun()}") from err
        finally:
            connection.close()
        time.sleep(_PAUSE_S)


class ViewerHandler(DoorHandler):
    """Serves Rerun's web viewer, and `frames` to browsers with the `cookie`.

    Rerun's page loads fonts, release news and examples, and sends usage statistics. The policy allows
    connections to this server only. It is a server of its own so that browsers draw in a process of its own,
    and the bar at the port `page` is not delayed.
    """

    page: int
    cookie: str
    files: Mapping[str, File]
    frames: FrameStream

    def do_GET(self) -> None:
        """Answer with a file of the viewer."""
        file = self.files.get(self.path.partition("?")[0])
        if file is None:
            self.refuse("there is no such page", HTTPStatus.NOT_FOUND)
        else:
            # The viewer shows how much of its program has arrived; a process of its own draws it.
            length = {"rerun_final_length": str(len(file.content))}
            self.send(HTTPStatus.OK, file.kind, file.content, Origin_Agent_Cluster="?1", **length)

    def do_POST(self) -> None:
        """Answer with frames."""
        if self.body(_REQUEST_BYTES_MAX) is None or not self.is_ours():
            return
        given = (self.headers["Cookie"] or "").split("; ")
        if not any(secrets.compare_digest(each.encode(), self.cookie.encode()) for each in given):
            self.refuse("to see the run, open the whole address that nurbseg-live has logged")
        elif self.path != READ_MESSAGES:
            self.refuse("only frames can be requested", HTTPStatus.NOT_FOUND)
        else:
            self._send_frames()

    def _send_frames(self) -> None:
        """Send frames until the run ends, or the browser is gone."""
        self.close_connection = True
        self.connection.settimeout(_STALL_S)
        try:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", GRPC_WEB)
            self.send_header("Connection", "close")
            self.finish_headers()
            for part in self.frames.parts(_LOOK_S):
                if not part and self._is_gone():
                    return
                self.wfile.write(part)
            self.wfile.write(END)
        except OSError:
            return

    def _is_gone(self) -> bool:
        """Whether the browser has closed the connection: it sends nothing else."""
        return bool(select.select([self.connection], [], [], 0)[0])

    def policy(self) -> str:
        """Return a policy that allows connections to this server only."""
        return (
            f"default-src 'self'; frame-ancestors {self.origin(self.page)}; "
            "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; worker-src 'self' blob:; "
            "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
            "connect-src 'self' data: blob:; form-action 'none'; base-uri 'none'"
        )
