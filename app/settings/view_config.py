"""Settings of the viewer: where to show and save, and in which detail."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from nurbseg.common.settings import Settings, check_ip_address, setting

ViewMode = Literal["auto", "spawn", "connect", "serve", "none"]
SaveIndex = Literal["auto", "on", "off"]
Layout = Literal["full", "compact"]

#: Rerun's usual ports, for its viewers and for its web page.
DEFAULT_PORT, DEFAULT_WEB_PORT = 9876, 9090


@dataclass(frozen=True, slots=True)
class ViewConfig(Settings):
    """Settings of the live view and of the saved recording.

    Raises ValueError if a value is out of its bounds, an address cannot be read, or settings contradict each
    other.
    """

    mode: ViewMode = setting(
        "auto",
        "where to show: auto (a window if there is a display), spawn a viewer, connect to one, "
        "serve a web page, none",
        flag="view",
    )
    connect: str | None = setting(
        None, f"viewer to connect to: HOST, HOST:{DEFAULT_PORT} or rerun+http://HOST:PORT/proxy", unit="URL"
    )
    save: str | None = setting(None, "save everything shown as a Rerun recording (.rrd)", unit="FILE")
    save_index: SaveIndex = setting(
        "auto",
        "write an index at the end of the file, for which memory grows by 50 MB a minute; auto: not in "
        "live runs",
    )
    bind: str = setting("127.0.0.1", "address that a spawned viewer or the web page listens on", unit="IP")
    port: int = setting(DEFAULT_PORT, "port of the viewer, 0 for any free one", least=0, most=65535)
    web_port: int = setting(DEFAULT_WEB_PORT, "port of the web page, 0 for any free one", least=0, most=65535)
    memory_limit: str = setting(
        "2GB", "memory above which a spawned viewer or the server drops the oldest frames", unit="SIZE"
    )
    layout: Layout = setting("full", "amount shown at once: full, or compact for a small screen")
    jpeg_quality: int = setting(85, "quality of the color images shown and saved", least=1, most=100)
    points_max: int = setting(20_000, "colored points shown per frame", least=0)
    mesh_step_px: int = setting(
        6, "vertex spacing of the surface meshes, in pixels of a 640x480 image", unit="px", least=1
    )
    residual_max_m: float = setting(
        0.02, "residual drawn in full red on the surfaces; 0 is blue", unit="m", above=0.0
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        check_ip_address("bind", self.bind)
        if self.save is not None and Path(self.save).suffix.lower() not in (".rrd", ""):
            raise ValueError(f"save: expected a name that ends in .rrd, got {self.save!r}")
        if re.fullmatch(r"\d+(%|[KMG]i?B)", self.memory_limit) is None:
            raise ValueError(f"memory_limit: expected a size such as 2GB or 25%, got {self.memory_limit!r}")
        if self.connect is not None:
            if self.mode not in ("auto", "connect"):
                raise ValueError(f"connect: needs --view connect or auto, got {self.mode}")
            viewer_address(self.connect)

    @property
    def is_wanted(self) -> bool:
        """Whether results are to be shown or saved."""
        return self.mode != "none" or self.save is not None

    @property
    def viewer_url(self) -> str:
        """URL of the viewer to connect to, in Rerun's form."""
        if self.connect is None:
            return f"rerun+http://127.0.0.1:{self.port or DEFAULT_PORT}/proxy"
        host, port = viewer_address(self.connect)
        scheme = urlsplit(self.connect).scheme if "://" in self.connect else "rerun+http"
        return f"{scheme}://{bracketed(host)}:{port}/proxy"


def bracketed(host: str) -> str:
    """Return a host as it is written in a URL: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def viewer_address(url: str) -> tuple[str, int]:
    """Return host and port of a viewer: ``HOST``, ``HOST:PORT`` or ``rerun+http://HOST:PORT/proxy``."""
    parts = urlsplit(url if "://" in url else f"rerun+http://{url}/proxy")
    expected = f"HOST, HOST:{DEFAULT_PORT} or rerun+http://HOST:{DEFAULT_PORT}/proxy"
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    schemes = ("rerun", "rerun+http", "rerun+https")
    if not host or port == 0 or parts.scheme not in schemes or parts.path not in ("", "/", "/proxy"):
        raise ValueError(f"connect: expected {expected}, got {url!r}")
    return host, port or DEFAULT_PORT
