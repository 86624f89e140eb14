"""Where OpenNI2 is installed and which drivers it will load, as its files show it."""

import configparser
import os
import sysconfig
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from nurbseg.drivers.openni2.library import LIBRARY_FILE, REDIST_VARIABLE

_DEBIAN_INI = "/etc/openni2/OpenNI.ini"


@dataclass(frozen=True, slots=True)
class Installation:
    """Where OpenNI2 is and which drivers it will load; empty where there is none.

    `redist` is the value of `OPENNI2_REDIST`. The `drivers` are the files in `drivers_folder` with the ending
    that the library loads, `suffix`: ``".so.0"`` for Debian's, ``".so"`` for a vendor's. `ini` is the
    OpenNI.ini that it reads, `repository` and `override` what that sets in place of the default drivers
    folder, and as the only device to open.
    """

    library: str = ""
    redist: str = ""
    drivers_folder: str = ""
    drivers: tuple[str, ...] = ()
    suffix: str = ".so.0"
    ini: str = ""
    repository: str = ""
    override: str = ""


def find_installation(root: Path = Path("/"), environ: Mapping[str, str] = os.environ) -> Installation:
    """Return where OpenNI2 is found first in the file system that starts at `root`, and what it will load."""
    redist = environ.get(REDIST_VARIABLE, "")
    multiarch = sysconfig.get_config_var("MULTIARCH") or ""
    own = [word.strip("/") for word in environ.get("LD_LIBRARY_PATH", "").split(":") if word]
    usual = [f"usr/lib/{multiarch}", f"lib/{multiarch}", "usr/local/lib", "usr/lib64", "usr/lib", "lib"]
    folders = [Path(redist)] if redist else [root / folder for folder in own + usual]
    library = next((folder / LIBRARY_FILE for folder in folders if (folder / LIBRARY_FILE).is_file()), None)
    if library is None:
        return Installation(redist=redist)
    # Strings in the library show where it reads its settings and which endings it loads.
    try:
        content = library.read_bytes()
    except OSError:
        content = b""
    suffix = ".so.0" if b"\0.so.0\0" in content else ".so"
    debian = _DEBIAN_INI.encode() in content
    ini = root / _DEBIAN_INI.removeprefix("/") if debian else library.parent / "OpenNI.ini"
    parser = configparser.ConfigParser(strict=False, interpolation=None, inline_comment_prefixes=(";",))
    try:
        parser.read_string(ini.read_text(encoding="utf-8", errors="replace"))
    except (OSError, configparser.Error):
        parser.clear()
    repository = parser.get("Drivers", "Repository", fallback="").strip(' "')
    drivers_folder = library.parent / (repository or "OpenNI2/Drivers")
    return Installation(
        library=str(library),
        redist=redist,
        drivers_folder=str(drivers_folder),
        drivers=tuple(sorted(path.name for path in drivers_folder.glob(f"*{suffix}"))),
        suffix=suffix,
        ini=str(ini),
        repository=repository,
        override=parser.get("Device", "Override", fallback="").strip(' "'),
    )
