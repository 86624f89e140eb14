"""The served page: the bar on one port, Rerun's viewer and the frames on another."""

import logging
import os
import socket
from collections.abc import Callable
from ipaddress import ip_address

from nurbseg.app.errors import ViewError
from nurbseg.app.settings.output_config import ViewConfig, bracketed
from nurbseg.app.view import viewer
from nurbseg.app.view.page.board import Board
from nurbseg.app.view.page.frames import FrameStream
from nurbseg.app.view.page.server import PageServer
from nurbseg.app.view.page.viewer_port import ViewerServer, viewer_files
from nurbseg.app.view.stream import Opening

logger = logging.getLogger(__name__)

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "Ki": 2**10, "Mi": 2**20, "Gi": 2**30}


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
        files = viewer_files()
        self.frames = FrameStream(opening, _bytes(config.memory_limit))
        try:
            self._viewer = ViewerServer(config.bind, port, web_port, files, self.frames, board.viewer_key)
            self._page = PageServer(config.bind, web_port, port, board)
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
