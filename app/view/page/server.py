"""The HTTP server of the page: the bar, the state of the run and its commands, and Rerun's own page."""

import http.client
import re
import shutil
import socket
import threading
import time
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from ipaddress import ip_address
from urllib.parse import parse_qs, urlsplit

from nurbseg.app.view.page.board import Board

#: Longest wait for Rerun's answer, and for a browser to take it; seconds.
_TIMEOUT_S = 30.0
#: Longest wait for Rerun's server to start, and pause between two tries; seconds.
_START_S, _PAUSE_S = 10.0, 0.1
#: Longest wait for the server's thread to end, seconds.
_CLOSE_S = 5.0
#: Longest wait for a change of the run's state before the browser asks again, seconds.
_CHANGE_S = 10.0
#: Longest command, bytes.
_COMMAND_BYTES_MAX = 200
#: Links to fonts of other hosts, and to hosts that a browser would connect to in advance.
_FOREIGN_LINK = re.compile(rb'<link\b[^>]*href="https?://[^>]*>')
_PASSED_ON = ("Content-Type", "Content-Encoding", "rerun-final-length")
#: Files of the bar, by the path at which the browser finds them.
_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/bar.css": ("bar.css", "text/css; charset=utf-8"),
    "/bar.js": ("bar.js", "text/javascript; charset=utf-8"),
}
_JSON, _TEXT = "application/json", "text/plain; charset=utf-8"


class PageServer:
    """Serves the bar, and forwards the files of Rerun's web server, with a Content-Security-Policy.

    Rerun's page loads fonts, release news and examples, and sends usage statistics. The policy allows
    connections only to this server and to the port of the frames, on the host named in the browser's request.
    Only those who know the token of `board` see and control the run.
    """

    def __init__(self, bind: str, port: int, rerun: tuple[str, int], stream_port: int, board: Board) -> None:
        class Handler(_Handler):
            upstream, stream = rerun, stream_port

        Handler.board = board

        class Server(ThreadingHTTPServer):
            address_family = socket.AF_INET6 if ":" in bind else socket.AF_INET

        self._server = Server((bind, port), Handler)
        self._server.timeout = _PAUSE_S
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="view-page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._closed.set()
        self._thread.join(_CLOSE_S)
        self._server.server_close()

    def _run(self) -> None:
        while not self._closed.is_set():
            self._server.handle_request()


class _Handler(BaseHTTPRequestHandler):
    upstream: tuple[str, int]
    stream: int
    board: Board
    timeout = _TIMEOUT_S
    # Otherwise a content waits until its head was acknowledged, for up to 40 ms.
    disable_nagle_algorithm = True
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        path, _, query = self.path.partition("?")
        if path in _FILES:
            name, kind = _FILES[path]
            self._send(HTTPStatus.OK, kind, (files("nurbseg.app.view.page") / name).read_bytes())
        elif path == "/run":
            if self._may_control():
                after = parse_qs(query).get("after", ["0"])[0]
                text = self.board.wait(int(after) if after.isdecimal() else 0, _CHANGE_S)
                self._send(HTTPStatus.OK, _JSON, text)
        elif path == "/explanation":
            if self._may_control():
                try:
                    self._send(HTTPStatus.OK, _TEXT, self.board.explanation())
                except OSError as err:
                    self._refuse(f"the explanation cannot be read: {err.strerror}", HTTPStatus.NOT_FOUND)
        else:
            self._forward(f"/?{query}" if path == "/viewer" else self.path)

    def do_POST(self) -> None:
        length = self.headers["Content-Length"] or ""
        if not length.isdecimal() or int(length) > _COMMAND_BYTES_MAX:
            # What is not read would be taken for the next request.
            self.close_connection = True
            self._refuse(f"expected a command of at most {_COMMAND_BYTES_MAX} bytes", HTTPStatus.BAD_REQUEST)
            return
        line = self.rfile.read(int(length)).decode(errors="replace").strip()
        if not self._may_control():
            return
        if self.path != "/run" or not line.isprintable() or not line:
            self._refuse("expected one command, at /run", HTTPStatus.BAD_REQUEST)
            return
        self._send(HTTPStatus.ACCEPTED, _TEXT, str(self.board.ask(line)).encode())

    def _may_control(self) -> bool:
        """Whether the token is right, and this is no page of another host; otherwise refuse.

        A name of this server that another host's DNS could have given is none: a page of that host would be
        of the same origin.
        """
        host, name = self._host(), socket.gethostname().lower()
        is_ours = host in ("localhost", name, f"{name}.local") or _is_address(host)
        if not is_ours or self.headers["Origin"] not in (None, f"http://{self.headers['Host']}"):
            self._refuse("this page is of another host: open the address that nurbseg-live has logged")
        elif not self.board.knows(self.headers["X-Token"] or ""):
            self._refuse("to control the run, open the whole address that nurbseg-live has logged")
        else:
            return True
        return False

    def _refuse(self, why: str, status: HTTPStatus = HTTPStatus.FORBIDDEN) -> None:
        self._send(status, _TEXT, why.encode())

    def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
        try:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self._end_headers()
            self.wfile.write(content)
        except OSError:
            self.close_connection = True

    def _end_headers(self) -> None:
        self.send_header("Content-Security-Policy", self._policy())
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()

    def _forward(self, path: str) -> None:
        """Send what Rerun's server has at a path."""
        connection = http.client.HTTPConnection(*self.upstream, timeout=_TIMEOUT_S)
        try:
            answer = self._answer(connection, path)
            is_page = answer.headers.get_content_type() == "text/html"
            page = _FOREIGN_LINK.sub(b"", answer.read()) if is_page else None
            length = answer.headers["Content-Length"] if page is None else str(len(page))
            self.send_response(answer.status)
            for name in _PASSED_ON:
                if (value := answer.headers[name]) is not None:
                    self.send_header(name, value)
            # A chunked answer of Rerun has no length and ends with the connection.
            self.send_header(*(("Connection", "close") if length is None else ("Content-Length", length)))
            self._end_headers()
            if page is not None:
                self.wfile.write(page)
            else:
                shutil.copyfileobj(answer, self.wfile, 1 << 20)
        except (OSError, http.client.HTTPException):
            self.close_connection = True
        finally:
            connection.close()

    def _answer(self, connection: http.client.HTTPConnection, path: str) -> http.client.HTTPResponse:
        """Request the file from Rerun, which may still be starting."""
        deadline_s = time.monotonic() + _START_S
        while True:
            try:
                connection.request("GET", path)
                return connection.getresponse()
            except (OSError, http.client.HTTPException):
                if time.monotonic() > deadline_s:
                    raise
            connection.close()
            time.sleep(_PAUSE_S)

    def _host(self) -> str:
        """Return the name or address by which the browser calls this server; empty if there is none."""
        try:
            return urlsplit(f"//{self.headers['Host']}").hostname or ""
        except ValueError:
            return ""

    def _policy(self) -> str:
        host, port = self._host(), self.connection.getsockname()[1]
        named = re.fullmatch(r"[\w.:-]+", host)
        frames = "" if named is None else f" http://{f'[{host}]' if ':' in host else host}:{self.stream}"
        ours = f"'self' http://127.0.0.1:{port} http://localhost:{port}"
        return (
            f"default-src 'self'; frame-src {ours}; frame-ancestors {ours}; "
            "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; worker-src 'self' blob:; "
            "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
            f"connect-src 'self' data: blob:{frames}; form-action 'none'; base-uri 'none'"
        )

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


def _is_address(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return False
    return True
