"""The served page: the bar, the state of the run and its commands; beside it Rerun's viewer."""

import logging
import os
import re
import socket
from collections.abc import Callable
from http import HTTPStatus
from importlib.resources import files
from ipaddress import ip_address
from urllib.parse import parse_qs

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig, bracketed
from nurbseg.app.view import viewer
from nurbseg.app.view.page.board import Board
from nurbseg.app.view.page.door import TEXT, DoorHandler, DoorServer
from nurbseg.app.view.page.frames import FrameStream
from nurbseg.app.view.page.viewer_port import ViewerHandler, viewer_files
from nurbseg.app.view.stream import Opening

logger = logging.getLogger(__name__)

#: Longest wait for a change of the run's state before the browser asks again, seconds.
_CHANGE_S = 10.0
#: Longest command, bytes.
_COMMAND_BYTES_MAX = 200
#: Files of the bar, by the path at which the browser finds them.
_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/bar.css": ("bar.css", "text/css; charset=utf-8"),
    "/bar.js": ("bar.js", "text/javascript; charset=utf-8"),
}
_JSON = "application/json"
_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "Ki": 2**10, "Mi": 2**20, "Gi": 2**30}


class PageHandler(DoorHandler):
    """Serves the bar to everyone, and the run to those who know the token of `board`.

    They get a cookie, too, which opens the port of the viewer to their browser.
    """

    viewer: int
    board: Board

    def do_GET(self) -> None:
        """Answer with a part of the bar, the state of the run, or its explanation."""
        path, _, query = self.path.partition("?")
        if path in _FILES:
            name, kind = _FILES[path]
            self.send(HTTPStatus.OK, kind, (files("nurbseg.app.view.page") / name).read_bytes())
        elif not self._may_control():
            return
        elif path == "/run":
            after = parse_qs(query).get("after", ["0"])[0]
            known = int(after) if re.fullmatch("[0-9]{1,9}", after) else 0
            self.send(HTTPStatus.OK, _JSON, self.board.wait(known, _CHANGE_S))
        elif path == "/explanation":
            try:
                self.send(HTTPStatus.OK, TEXT, self.board.explanation())
            except OSError as err:
                self.refuse(f"the explanation cannot be read: {err.strerror}", HTTPStatus.NOT_FOUND)
        elif path == "/viewer":
            # Browsers keep cookies by host, not by port: with the port in its name, two runs can be watched.
            key = f"nurbseg-{self.viewer}={self.board.viewer_key}; HttpOnly; SameSite=Strict; Path=/"
            self.send(HTTPStatus.OK, TEXT, str(self.viewer).encode(), Set_Cookie=key)
        else:
            self.refuse("there is no such page", HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Take a command."""
        if (content := self.body(_COMMAND_BYTES_MAX)) is None or not self._may_control():
            return
        line = content.decode(errors="replace").strip()
        if self.path != "/run" or not line.isprintable() or not line:
            self.refuse("expected one command, at /run", HTTPStatus.BAD_REQUEST)
            return
        self.send(HTTPStatus.ACCEPTED, TEXT, str(self.board.ask(line)).encode())

    def _may_control(self) -> bool:
        """Whether this is a page of ours, and its user has the token; refuse the request if not."""
        if not self.is_ours():
            return False
        if self.board.knows(self.headers["X-Token"] or ""):
            return True
        self.refuse("to control the run, open the whole address that nurbseg-live has logged")
        return False

    def policy(self) -> str:
        """Return a policy that also holds for explanations."""
        # An explanation, in a frame without an origin, has this policy, too; its style and script are inline.
        return (
            f"default-src 'self'; frame-src {self.origin(self.viewer)}; frame-ancestors 'none'; "
            "script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
            "img-src 'self' data: blob:; form-action 'none'; base-uri 'none'"
        )


class WebServer:
    """Serves a run to browsers: what it shows at `page_url`; commands given there are passed on to `ask`.

    Raises ViewError if a port is in use or the viewer's files cannot be read.
    """

    def __init__(self, config: ViewConfig, opening: Opening, ask: Callable[[str, int], object]) -> None:
        port = config.port or viewer.free_port(config.bind)
        web_port = config.web_port or viewer.free_port(config.bind)
        for name, number in (("port", port), ("web port", web_port)):
            if viewer.is_taken(config.bind, number):
                raise ViewError(
                    f"{name} {number} of {config.bind} is in use; choose another one, or 0 for any"
                )
        board = Board(ask)
        pages = viewer_files()
        self.frames = FrameStream(opening, _bytes(config.memory_limit))
        try:
            self._viewer = DoorServer(
                config.bind,
                port,
                ViewerHandler,
                page=web_port,
                cookie=f"nurbseg-{port}={board.viewer_key}",
                files=pages,
                frames=self.frames,
            )
            self._page = DoorServer(config.bind, web_port, PageHandler, viewer=port, board=board)
        except OSError as err:
            raise ViewError(f"ports {port} and {web_port} of {config.bind}: {err.strerror}") from err
        host = viewer.reachable(config.bind)
        viewer.warn_beyond_loopback(
            config.bind, port, web_port, lacks="encryption, and its token can be read"
        )
        self.page_url = f"http://{bracketed(host)}:{web_port}/#{board.token}"
        self.tell = board.tell
        if ip_address(host).is_loopback:
            ports = " ".join(f"-L {each}:{host}:{each}" for each in (web_port, port))
            logger.info("from another computer, first: ssh %s %s", ports, socket.gethostname())

    def close(self) -> None:
        """Stop serving."""
        self._page.close()
        self._viewer.close()


def _bytes(size: str) -> int:
    """Return the bytes of a size such as 2GB, 500MiB or 25% (of the memory of this computer)."""
    if size.endswith("%"):
        return int(size[:-1]) * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 100
    number = size.rstrip("KMGiB")
    return int(number) * _UNITS[size[len(number) : -1]]
