"""Settings of what a run shows, writes for each frame, explains, records and publishes."""

import re
import time
from dataclasses import Field, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple
from urllib.parse import urlsplit

from nurbseg.common.settings import Settings, check_ip_address, described_fields, setting
from nurbseg.drivers.options import ColorFormat
from nurbseg.library.models.forms import CadForm, MeshForm

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


CloudForm = Literal["ply"]
Naming = Literal["number", "source"]


@dataclass(frozen=True, slots=True)
class ExportConfig(Settings):
    """Settings of the files written for each frame and for the run."""

    directory: str | None = setting(
        None, "folder for each frame's labels (PNG) and tree (JSON)", unit="DIR", flag="export"
    )
    surfaces: bool = setting(False, "also export the fitted surfaces (NPZ)", flag="export-surfaces")
    objects: bool = setting(
        False,
        "also export measurements of each object (JSON), and of all objects in a table (CSV)",
        flag="export-objects",
    )
    preview: bool = setting(
        False, "also export the frame with its objects outlined and numbered (PNG)", flag="export-preview"
    )
    cloud: CloudForm | None = setting(
        None, "also export the point cloud, with color, normal, surface and object", flag="export-cloud"
    )
    mesh: MeshForm | None = setting(
        None,
        "also export the surfaces as triangles, trimmed to their pixels, one part per object; in glb with "
        "the photo",
        flag="export-mesh",
    )
    cad: CadForm | None = setting(
        None,
        "also export the surfaces as trimmed NURBS, by object (needs the extra 'step')",
        flag="export-cad",
    )
    graph: bool = setting(False, "also export the tree as a graph for Graphviz (DOT)", flag="export-graph")
    names: Naming = setting(
        "number", "file names of a frame: its number, or its name in the source", flag="export-names"
    )
    report: str | None = setting(
        None, "file for the run's statistics: frames, drops, frame rate, latency, memory (JSON)", unit="FILE"
    )
    force: bool = setting(
        False, "overwrite existing results, reports and viewer files; recordings are never overwritten"
    )


def export_forms() -> list[Field[Any]]:
    """Return the settings of a frame's optional files and of file names."""
    return [field for field in described_fields(ExportConfig) if field.metadata["flag"].startswith("export-")]


@dataclass(frozen=True, slots=True)
class ExplainConfig(Settings):
    """Settings of the explanation of one frame."""

    what: str | None = setting(
        None,
        "show why one frame was segmented so, split by split, instead of a run: its number in the replay, or "
        "what to replay, of which the first frame is taken",
        unit="FRAME|PATH",
        flag="explain",
    )
    file: str | None = setting(
        None,
        "file for the explanation, a page for any browser (default: explanation-DATE-TIME-frameN.html)",
        unit="FILE",
        flag="explain-out",
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.file is not None and self.what is None:
            raise ValueError("file: expected a frame, too (--explain FRAME|PATH)")


def dated(name: str) -> str:
    """Replace ``{date}`` in a file name by the current date and time."""
    return name.replace("{date}", time.strftime("%Y%m%d-%H%M%S"))


@dataclass(frozen=True, slots=True)
class RecordConfig(Settings):
    """Settings of the recording that is made during a run.

    Raises ValueError if a value is out of bounds, or the file's name does not end in .mcap.
    """

    file: str | None = setting(
        None,
        "record the frames while they are segmented, as .mcap; {date} in the name, as for --save, becomes "
        "the date and time",
        unit="FILE",
        flag="record",
    )
    only: bool = setting(False, "record without segmenting or showing", flag="record-only")
    delay_s: float = setting(
        0.0,
        "start recording this long after the first frame; --frames and --duration count from there",
        unit="s",
        least=0.0,
        flag="record-delay",
    )
    split_s: float | None = setting(
        None,
        "start a new file (NAME-2.mcap, NAME-3.mcap ...) at this interval",
        unit="s",
        least=1.0,
        flag="record-split",
    )
    color: ColorFormat = setting(
        "jpeg95", "encoding of color: JPEG of quality 95, or lossless PNG or raw", flag="record-color"
    )
    space_min_mb: int = setting(
        200,
        "stop recording, with a readable file, when less disk space is left",
        unit="MB",
        least=1,
        flag="record-space-min",
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        if self.file is not None and not self.file.lower().endswith(".mcap"):
            known = " (.oni recordings are replayed, but not made)" * self.file.lower().endswith(".oni")
            raise ValueError(f"file: expected a name that ends in .mcap, got {self.file!r}{known}")
        for name in ("only", "delay_s", "split_s"):
            if getattr(self, name) and self.file is None:
                raise ValueError(f"{name}: expected a file to record to as well (--record FILE)")


#: Where a server for Foxglove listens unless a port is given.
FOXGLOVE_PORT = 8765


class Publication(NamedTuple):
    """One way of publishing: its kind and what follows the colon."""

    kind: str
    target: str


@dataclass(frozen=True, slots=True)
class PublishConfig(Settings):
    """Settings of what a run gives to other programs while it goes on.

    Raises ValueError if a way of publishing is unknown, or an address is none.
    """

    how: str | None = setting(
        None,
        "give results to other programs: jsonl (a line per frame on standard output), jsonl:PATH (on a Unix "
        "socket), foxglove or foxglove:PORT (8765; pip install 'nurbseg[foxglove]'), or several with commas",
        unit="HOW",
        flag="publish",
    )
    bind: str = setting(
        "127.0.0.1", "address that the server for Foxglove listens on", unit="IP", flag="publish-bind"
    )

    def __post_init__(self) -> None:
        Settings.__post_init__(self)
        check_ip_address("bind", self.bind)
        for publication in self.publications:
            if publication.kind not in ("jsonl", "foxglove"):
                raise ValueError(f"how: expected jsonl or foxglove, got {publication.kind!r}")
            if publication.kind == "foxglove" and publication.target and not _is_port(publication.target):
                raise ValueError(f"how: expected a port from 1 to 65535, got {publication.target!r}")

    @property
    def is_wanted(self) -> bool:
        """Whether anything is published."""
        return self.how is not None

    @property
    def publications(self) -> tuple[Publication, ...]:
        """What is asked for, in order."""
        asked = [] if self.how is None else self.how.split(",")
        return tuple(Publication(*each.strip().partition(":")[::2]) for each in asked)


def _is_port(text: str) -> bool:
    return re.fullmatch("[0-9]{1,5}", text) is not None and 1 <= int(text) <= 65535
