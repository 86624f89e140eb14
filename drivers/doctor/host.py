"""The host's state, as its files show it: container, udev rules, OpenNI2's installation."""

import configparser
import re
import sysconfig
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from nurbseg.drivers.doctor.usb import read_text
from nurbseg.drivers.openni2.library import LIBRARY_FILE, REDIST_VARIABLE

DEBIAN_INI = "/etc/openni2/OpenNI.ini"

HostKind = Literal["computer", "container", "wsl"]

_RULE_FOLDERS = ("etc/udev/rules.d", "run/udev/rules.d", "usr/lib/udev/rules.d", "lib/udev/rules.d")
_CONTAINER_MARKS = (".dockerenv", "run/.containerenv", "run/systemd/container")
_PERMISSION = re.compile(r"(?<![A-Z_])(MODE|GROUP)\s*:?=[^=]|uaccess")
_CONTAINER_GROUPS = re.compile(r"docker|containerd|kubepods|lxc|libpod")


@dataclass(frozen=True, slots=True)
class Installation:
    """Where OpenNI2 is and which drivers it will load; empty where there is none.

    `redist` is the value of `OPENNI2_REDIST`. Of the library files in `drivers_folder`, those in `drivers`
    have the ending that the library loads, `suffix`: ``".so.0"`` for Debian's, ``".so"`` for a vendor's.
    `ini` is the OpenNI.ini that it reads, `repository` and `override` what that sets in place of the default
    drivers folder, and as the only device to open.
    """

    library: str = ""
    redist: str = ""
    drivers_folder: str = ""
    drivers: tuple[str, ...] = ()
    unloadable: tuple[str, ...] = ()
    suffix: str = ".so.0"
    ini: str = ""
    repository: str = ""
    override: str = ""

    def has_driver(self, file_stem: str) -> bool:
        """Whether a driver will be loaded whose file name begins with this, in lower case."""
        return any(driver.lower().startswith(file_stem) for driver in self.drivers)


@dataclass(frozen=True, slots=True)
class Host:
    """The computer around the USB bus.

    `rules` are the vendor and product ids that some udev rule names, None for all of a vendor's products.
    """

    kind: HostKind = "computer"
    rules: frozenset[tuple[int, int | None]] = frozenset()
    installation: Installation = Installation()

    def has_rule(self, vendor_id: int, product_id: int) -> bool:
        """Whether a udev rule names the device."""
        return (vendor_id, product_id) in self.rules or (vendor_id, None) in self.rules


def read_host(root: Path, environ: Mapping[str, str]) -> Host:
    """Read the facts from the file system that starts at `root`."""
    return Host(
        kind=_kind(root, environ), rules=_ruled_ids(root), installation=find_installation(root, environ)
    )


def find_installation(root: Path, environ: Mapping[str, str]) -> Installation:
    """Return where OpenNI2 is found first, and what it will load."""
    redist = environ.get(REDIST_VARIABLE, "")
    folders = [Path(redist)] if redist else [root / folder for folder in _library_folders(environ)]
    library = next((folder / LIBRARY_FILE for folder in folders if (folder / LIBRARY_FILE).is_file()), None)
    if library is None:
        return Installation(redist=redist)
    # Strings in the library show where it reads its settings and which endings it loads.
    try:
        content = library.read_bytes()
    except OSError:
        content = b""
    suffix = ".so.0" if b"\0.so.0\0" in content else ".so"
    debian = DEBIAN_INI.encode() in content
    ini = root / DEBIAN_INI.removeprefix("/") if debian else library.parent / "OpenNI.ini"
    repository, override = _read_ini(ini)
    drivers_folder = library.parent / (repository or "OpenNI2/Drivers")
    names = sorted(path.name for path in drivers_folder.glob("*.so*"))
    return Installation(
        library=str(library),
        redist=redist,
        drivers_folder=str(drivers_folder),
        drivers=tuple(name for name in names if name.endswith(suffix)),
        unloadable=tuple(name for name in names if not name.endswith(suffix)),
        suffix=suffix,
        ini=str(ini) if ini.is_file() else "",
        repository=repository,
        override=override,
    )


def _library_folders(environ: Mapping[str, str]) -> list[str]:
    """Return where the loader looks for the library, relative to the file system's root."""
    multiarch = sysconfig.get_config_var("MULTIARCH") or ""
    usual = [f"usr/lib/{multiarch}", f"lib/{multiarch}", "usr/local/lib", "usr/lib64", "usr/lib", "lib"]
    own = [word.strip("/") for word in environ.get("LD_LIBRARY_PATH", "").split(":") if word]
    return [each for each in own + usual if not each.endswith("/")]


def _read_ini(path: Path) -> tuple[str, str]:
    """Return what OpenNI.ini sets as drivers folder and as the only device; empty where it does not."""
    parser = configparser.ConfigParser(strict=False, interpolation=None, inline_comment_prefixes=(";",))
    try:
        parser.read_string(path.read_text(encoding="utf-8", errors="replace"))
    except (OSError, configparser.Error):
        return "", ""

    def value(section: str, name: str) -> str:
        return parser.get(section, name, fallback="").strip().strip('"')

    return value("Drivers", "Repository"), value("Device", "Override")


def _kind(root: Path, environ: Mapping[str, str]) -> HostKind:
    if "microsoft" in read_text(root / "proc/version").lower():
        return "wsl"
    marked = any((root / mark).exists() for mark in _CONTAINER_MARKS) or "container" in environ
    if marked or _CONTAINER_GROUPS.search(read_text(root / "proc/1/cgroup")):
        return "container"
    return "computer"


def _ruled_ids(root: Path) -> frozenset[tuple[int, int | None]]:
    ids: set[tuple[int, int | None]] = set()
    for folder in _RULE_FOLDERS:
        for path in (root / folder).glob("*.rules"):
            for line in read_text(path).splitlines():
                # Other rules name ids too, to give a device a name or a power setting.
                if line.lstrip().startswith("#") or not _PERMISSION.search(line):
                    continue
                vendor = re.search(r'ATTRS?\{idVendor\}=="([0-9a-fA-F]{4})"', line)
                product = re.search(r'ATTRS?\{idProduct\}=="([0-9a-fA-F]{4})"', line)
                if vendor:
                    ids.add((int(vendor[1], 16), int(product[1], 16) if product else None))
    return frozenset(ids)
