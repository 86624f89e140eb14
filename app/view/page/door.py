"""What the servers of the page and of the viewer share: who is let in, and how answers are sent."""

import re
import socket
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

#: Longest wait for a browser to send a request or to take an answer, seconds.
_TIMEOUT_S = 30.0
#: Time between two looks whether the server is to end, and longest wait for its thread to end, seconds.
_PAUSE_S, _CLOSE_S = 0.1, 5.0
TEXT = "text/plain; charset=utf-8"


class DoorHandler(BaseHTTPRequestHandler):
    """Answers requests with a Content-Security-Policy and without logging them."""

    timeout = _TIMEOUT_S
    # Otherwise a content waits until its head was acknowledged, for up to 40 ms.
    disable_nagle_algorithm = True
    protocol_version = "HTTP/1.1"

    def policy(self) -> str:
        """Return the Content-Security-Policy of all answers."""
        raise NotImplementedError

    def body(self, most: int) -> bytes | None:
        """Return the content of a request; None, and a refusal, if it has more than `most` bytes."""
        length = self.headers["Content-Length"] or ""
        if not re.fullmatch("[0-9]{1,9}", length) or int(length) > most:
            # Unread bytes would be taken for the next request.
            self.close_connection = True
            self.refuse(f"expected a content of at most {most} bytes", HTTPStatus.BAD_REQUEST)
            return None
        return self.rfile.read(int(length))

    def is_ours(self) -> bool:
        """Whether the request is of a page of this server; refuse it if not.

        A host name that another host's DNS resolves to this computer is not accepted: a page of that host
        would be of the same origin.
        """
        host, name = self.host(), socket.gethostname().lower()
        is_ours = host in ("localhost", name, f"{name}.local") or _is_address(host)
        if is_ours and self.headers["Origin"] in (None, f"http://{self.headers['Host']}"):
            return True
        self.refuse("this page is of another host: open the address that nurbseg-live has logged")
        return False

    def refuse(self, why: str, status: HTTPStatus = HTTPStatus.FORBIDDEN) -> None:
        """Send an error and its reason."""
        self.send(status, TEXT, why.encode())

    def send(self, status: HTTPStatus, kind: str, content: bytes, **headers: str) -> None:
        """Send a whole answer; `headers` are further ones, with ``_`` for ``-``."""
        try:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            for name, value in headers.items():
                self.send_header(name.replace("_", "-"), value)
            self.finish_headers()
            self.wfile.write(content)
        except OSError:
            self.close_connection = True

    def finish_headers(self) -> None:
        """Add the headers of all answers, and end them."""
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", self.policy())
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()

    def host(self) -> str:
        """Return the name or address by which the browser calls this server; empty if there is none."""
        try:
            return urlsplit(f"//{self.headers['Host']}").hostname or ""
        except ValueError:
            return ""

    def origin(self, port: int) -> str:
        """Return the origin of another port of this host for a policy; empty if the host is malformed."""
        host = self.host()
        if re.fullmatch(r"[\w.:-]+", host) is None:
            return ""
        return f"http://{f'[{host}]' if ':' in host else host}:{port}"

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""


class DoorServer:
    """Serves with a handler, in threads, until it is closed; raises OSError if it cannot listen there.

    `shared` are attributes of the handler.
    """

    def __init__(self, bind: str, port: int, handler: type[DoorHandler], **shared: Any) -> None:
        class Server(ThreadingHTTPServer):
            address_family = socket.AF_INET6 if ":" in bind else socket.AF_INET

        self._server = Server((bind, port), type("Handler", (handler,), shared))
        self._server.timeout = _PAUSE_S
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"view-port-{port}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._closed.set()
        self._thread.join(_CLOSE_S)
        self._server.server_close()

    def _run(self) -> None:
        while not self._closed.is_set():
            self._server.handle_request()


def _is_address(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return False
    return True
