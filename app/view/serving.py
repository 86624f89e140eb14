"""Rerun's web server as a process, and the page in front of it."""

import contextlib
import logging
import socket
import subprocess
import time
from collections.abc import Callable
from ipaddress import ip_address
from urllib.parse import quote

from nurbseg.app.control.commands import Asked
from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig, bracketed
from nurbseg.app.view import viewer
from nurbseg.app.view.page.board import Board
from nurbseg.app.view.page.server import PageServer
from nurbseg.common.process.child import exit_description

logger = logging.getLogger(__name__)

#: A server that ends within this time of its start, seconds, is not restarted.
_LASTING_S = 5.0
#: Longest wait for the process to end, seconds.
_CLOSE_S = 5.0


class WebServer:
    """Serves frames and the viewer to browsers from another process, the only one a stalled browser stalls.

    Frames are sent to `url`; browsers open `page_url`; commands given there are passed on to `ask`. Raises
    ViewError if a port is in use or the process cannot be started.
    """

    def __init__(self, config: ViewConfig, ask: Callable[[Asked], None] = lambda _: None) -> None:
        self._config = config
        self._given_up = False
        self.port = config.port or viewer.free_port(config.bind)
        web_port = config.web_port or viewer.free_port(config.bind)
        for name, number in (("port", self.port), ("web port", web_port)):
            if viewer.is_taken(config.bind, number):
                raise ViewError(
                    f"{name} {number} of {config.bind} is in use; choose another one, or 0 for any"
                )
        self._rerun_port = viewer.free_port(config.bind)
        self._start()
        host = viewer.reachable(config.bind)
        try:
            board = Board(ask)
            self._page = PageServer(config.bind, web_port, (host, self._rerun_port), self.port, board)
        except OSError as err:
            self._end()
            raise ViewError(f"web port {web_port} of {config.bind}: {err.strerror}") from err
        viewer.warn_beyond_loopback(config.bind, self.port, web_port, self._rerun_port)
        self.url = f"rerun+http://{bracketed(host)}:{self.port}/proxy"
        self.page_url = f"http://{bracketed(host)}:{web_port}/?url={quote(self.url, safe='')}#{board.token}"
        self.tell = board.tell
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
                "the web server %s soon after its start and will not be restarted", exit_description(code)
            )
            return
        logger.warning("the web server %s and is being restarted; reload the page", exit_description(code))
        try:
            self._start()
        except ViewError as err:
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
