"""Where the machine code of compiled loops is kept for later processes."""

import hashlib
import os
import shutil
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

from nurbseg.common.code.cache import UnusableFolderError, code_folder, user_cache

#: What marks a file whose functions are compiled.
_MARKS = (b"\n@compiled", b"\n@inlined")
#: Packages with such files.
_WITH_LOOPS = ("common", "drivers", "library", "recordings", "segmentation")
_PACKAGES = Path(__file__).resolve().parent.parent.parent
#: What to do where the code is not kept.
KEEP_CODE = "set XDG_CACHE_HOME to a folder that you, and nobody else, can write"
#: Folders of machine code that are kept, those used last: of this version and of some before it.
_KEPT = 3
#: A folder that was used within this time is kept as well: a process may still use it.
_IN_USE_S = 24 * 3600


@cache
def _folder(wanted: str, *others: Path) -> tuple[Path | None, str]:
    name = f"loops-{content_digest(_PACKAGES, *others)}"
    beside = Path(wanted or Path(__file__).parent.parent / "__pycache__")
    places: list[Callable[[], Path]] = [lambda: code_folder(beside, name)]
    if not wanted:
        places.append(lambda: code_folder(user_cache(), "nurbseg", name))
    problems = []
    for find in places:
        try:
            found = find()
        except UnusableFolderError as err:
            problems.append(str(err))
            continue
        _remove_old(found.parent)
        return found, ""
    return None, "; ".join(problems)


def folder(source: str = __file__) -> tuple[Path | None, str]:
    """Return the folder for the code of a file, created if necessary; None and why, if none can be used.

    It is that of this version, and for a file elsewhere also of what lies beside that.
    """
    beside = Path(source).resolve().parent
    others = () if beside.is_relative_to(_PACKAGES) else (beside,)
    return _folder(os.environ.get("NUMBA_CACHE_DIR", ""), *others)


def why_not_kept() -> str:
    """Say why compiled code is not kept for later processes; empty if it is kept."""
    return folder()[1]


def content_digest(packages: Path, *others: Path) -> str:
    """Return a digest of all files with compiled functions in our packages and in other folders."""
    digest = hashlib.sha256()
    for folder in (*(packages / name for name in _WITH_LOOPS), *others):
        for path in sorted(folder.rglob("*.py")):
            content = path.read_bytes()
            if any(mark in content for mark in _MARKS):
                digest.update(path.relative_to(folder.parent).as_posix().encode() + b"\0" + content)
    return digest.hexdigest()[:16]


def _remove_old(above: Path) -> None:
    """Remove all folders of code but those that were used last, and those that may be in use."""

    def used_s(folder: Path) -> float:
        try:
            return (folder / "used").stat().st_mtime
        except OSError:
            return 0.0

    for old in sorted(above.glob("loops-*"), key=used_s, reverse=True)[_KEPT:]:
        if used_s(old) < time.time() - _IN_USE_S:
            shutil.rmtree(old, ignore_errors=True)
