"""Rerun's web server as a process, and the page in front of it, without connections to other hosts."""

import contextlib
import http.client
import logging
import re
import shutil
import socket
import subprocess
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_address
from urllib.parse import quote, urlsplit

from nurbseg.app.settings.view_config import ViewConfig, bracketed
from nurbseg.app.view import viewer
from nurbseg.common.process.child import how_it_ended

logger = logging.getLogger(__name__)

#: A server that ends within this time of its start, seconds, is not restarted.
_LASTING_S = 5.0
#: Longest wait for Rerun's answer, and for a browser to take it; seconds.
_TIMEOUT_S = 30.0
#: Longest wait for Rerun's server to start, and pause between two tries; seconds.
_START_S, _PAUSE_S = 10.0, 0.1
#: Longest wait for the process, and for the thread of the page, to end; seconds.
_CLOSE_S = 5.0
#: Links to fonts of other hosts, and to hosts that a browser would connect to in advance.
_FOREIGN_LINK = re.compile(rb'<link\b[^>]*href="https?://[^>]*>')
_PASSED_ON = ("Content-Type", "Content-Encoding", "rerun-final-length")


class WebServer:
    """Serves frames and the viewer to browsers from another process, the only one a stalled browser stalls.

    Frames are sent to `url`; browsers open `page_url`. Raises ViewError if a port is in use or the process
    cannot be started.
    """

    def __init__(self, config: ViewConfig) -> None:
        self._config = config
        self._given_up = False
        self.port = config.port or viewer.free_port(config.bind)
        web_port = config.web_port or viewer.free_port(config.bind)
        for name, number in (("port", self.port), ("web port", web_port)):
            if viewer.is_taken(config.bind, number):
                raise viewer.ViewError(
                    f"{name} {number} of {config.bind} is in use; choose another one, or 0 for any"
                )
        self._rerun_port = viewer.free_port(config.bind)
        self._start()
        host = viewer.reachable(config.bind)
        try:
            self._page = PageServer(config.bind, web_port, (host, self._rerun_port), self.port)
        except OSError as err:
            self._end()
            raise viewer.ViewError(f"web port {web_port} of {config.bind}: {err.strerror}") from err
        viewer.warn_beyond_loopback(config.bind, self.port, web_port, self._rerun_port)
        self.url = f"rerun+http://{bracketed(host)}:{self.port}/proxy"
        self.page_url = f"http://{bracketed(host)}:{web_port}/?url={quote(self.url, safe='')}"
        if ip_address(host).is_loopback:
            ports = " ".join(f"-L {each}:{host}:{each}" for each in (web_port, self.port))
            logger.info("from another computer, first: ssh %s %s", ports, socket.gethostname())

    def _start(self) -> None:
        self._process = viewer.start_web_server(self._config, self.port, self._rerun_port)
        self._started_s = time.monotonic()

    def is_starting(self) -> bool:
        """Whether the server's process runs, though it may not listen yet."""
        return self._process.poll() is None

    def restart_if_ended(self) -> None:
        """Restart the server if it has ended; call from the thread that made this object."""
        code = self._process.poll()
        if code is None or self._given_up:
            return
        self._given_up = time.monotonic() - self._started_s < _LASTING_S
        if self._given_up:
            logger.warning(
                "the web server %s soon after its start and will not be restarted", how_it_ended(code)
            )
            return
        logger.warning("the web server %s and is being restarted; reload the page", how_it_ended(code))
        try:
            self._start()
        except viewer.ViewError as err:
            self._given_up = True
            logger.warning("the web server cannot be restarted: %s", err)

    def close(self) -> None:
        """Stop the server and its page."""
        self._page.close()
        self._end()

    def _end(self) -> None:
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_CLOSE_S)


class PageServer:
    """Forward the files of Rerun's web server with a Content-Security-Policy.

    Rerun's page loads fonts, release news and examples, and sends usage statistics. The policy allows
    connections only to this server and to the port of the frames, on the host named in the browser's request.
    """

    def __init__(self, bind: str, port: int, rerun: tuple[str, int], stream_port: int) -> None:
        class Handler(_Handler):
            upstream, stream = rerun, stream_port

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
    timeout = _TIMEOUT_S
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        connection = http.client.HTTPConnection(*self.upstream, timeout=_TIMEOUT_S)
        try:
            answer = self._answer(connection)
            is_page = answer.headers.get_content_type() == "text/html"
            page = _FOREIGN_LINK.sub(b"", answer.read()) if is_page else None
            length = answer.headers["Content-Length"] if page is None else str(len(page))
            self.send_response(answer.status)
            for name in _PASSED_ON:
                if (value := answer.headers[name]) is not None:
                    self.send_header(name, value)
            # A chunked answer of Rerun has no length and ends with the connection.
            self.send_header(*(("Connection", "close") if length is None else ("Content-Length", length)))
            self.send_header("Content-Security-Policy", self._policy())
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            if page is not None:
                self.wfile.write(page)
            else:
                shutil.copyfileobj(answer, self.wfile, 1 << 20)
        except (OSError, http.client.HTTPException):
            self.close_connection = True
        finally:
            connection.close()

    def _answer(self, connection: http.client.HTTPConnection) -> http.client.HTTPResponse:
        """Request the file from Rerun, which may still be starting."""
        deadline_s = time.monotonic() + _START_S
        while True:
            try:
                connection.request("GET", self.path)
                return connection.getresponse()
            except (OSError, http.client.HTTPException):
                if time.monotonic() > deadline_s:
                    raise
            connection.close()
            time.sleep(_PAUSE_S)

    def _policy(self) -> str:
        try:
            host = urlsplit(f"//{self.headers['Host']}").hostname or ""
        except ValueError:
            host = ""
        named = re.fullmatch(r"[\w.:-]+", host)
        frames = "" if named is None else f" http://{f'[{host}]' if ':' in host else host}:{self.stream}"
        return (
            "default-src 'self'; "
            "script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; worker-src 'self' blob:; "
            "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
            f"connect-src 'self' data: blob:{frames}; form-action 'none'; base-uri 'none'"
        )

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""
