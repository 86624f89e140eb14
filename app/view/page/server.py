"""The HTTP server of the page: the bar, the state of the run and its commands."""

import re
from http import HTTPStatus
from importlib.resources import files
from urllib.parse import parse_qs

from nurbseg.app.view.page.board import Board
from nurbseg.app.view.page.door import TEXT, DoorHandler, DoorServer

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


class PageServer(DoorServer):
    """Serves the bar to everyone, and the run to those who know the token of `board`.

    They get a cookie, too, which opens the port of the viewer (`viewer_port`) to their browser.
    """

    def __init__(self, bind: str, port: int, viewer_port: int, board: Board) -> None:
        class Handler(_Handler):
            viewer = viewer_port

        Handler.board = board
        super().__init__(bind, port, Handler)


class _Handler(DoorHandler):
    viewer: int
    board: Board

    def do_GET(self) -> None:
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
        # An explanation, in a frame without an origin, has this policy, too; its style and script are inline.
        return (
            f"default-src 'self'; frame-src {self.origin(self.viewer)}; frame-ancestors 'none'; "
            "script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
            "img-src 'self' data: blob:; form-action 'none'; base-uri 'none'"
        )
