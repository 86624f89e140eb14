"""Secure cache folder for compiled functions, and imports without configuration from the working folder."""

import hashlib
import os
import shutil
import stat
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from functools import cache
from pathlib import Path

#: What marks a file whose functions are compiled.
_MARKS = (b"\n@compiled", b"\n@inlined")
#: Packages with such files.
_WITH_LOOPS = ("common", "drivers", "library", "recordings", "segmentation")
_PACKAGES = Path(__file__).resolve().parent.parent
#: Advice where nothing is cached.
CACHE_ADVICE = "set XDG_CACHE_HOME to a folder of yours, in which nurbseg makes one that only you can enter"
#: Folders of machine code that stay, those used last: of this version and of some before it.
_KEPT = 3
#: A folder that was used within this time stays as well: a process may still use it.
_IN_USE_S = 24 * 3600


@contextmanager
def ignored_yaml() -> Iterator[None]:
    """Import Numba within the block: it reads a file of the working folder only where it finds PyYAML."""
    before = sys.modules.get("yaml")
    sys.modules["yaml"] = None  # type: ignore[assignment]
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "A Numba config file is found")
            yield
    finally:
        del sys.modules["yaml"]
        if before is not None:
            sys.modules["yaml"] = before


@contextmanager
def ignored_folder() -> Iterator[None]:
    """Import Matplotlib within the block: it would take the working folder's file before the user's own."""
    with chdir("/"):
        yield


class UnusableFolderError(Exception):
    """A folder cannot be used for code; the message names it and says why."""


def _user_cache() -> Path:
    """Return ``nurbseg`` in `XDG_CACHE_HOME` or ``~/.cache``.

    A relative path there is ignored, as the convention has it: the working folder must not decide. Raises
    UnusableFolderError where the user has no home.
    """
    named = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = Path(named) if Path(named).is_absolute() else Path("~/.cache").expanduser()
    except RuntimeError as err:  # as in some containers
        raise UnusableFolderError("the user has no home folder") from err
    if not folder.is_absolute():
        raise UnusableFolderError(f"{folder}: HOME is not an absolute path")
    return folder / "nurbseg"


def private_folder(path: Path) -> Path:
    """Return a folder, created if it is missing, that only this user can enter: it holds code that is run.

    Raises UnusableFolderError if the folder is another user's, open to others, a link or not to be written.
    """
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = path.lstat()
        if not stat.S_ISDIR(status.st_mode):
            raise UnusableFolderError(f"{path}: is a link")
        if status.st_uid != os.geteuid():
            raise UnusableFolderError(f"{path}: belongs to another user")
        if status.st_mode & 0o077:
            raise UnusableFolderError(f"{path}: other users can enter it (chmod 700 closes it)")
        # The time of the last use; fails where the folder cannot be written.
        (path / "used").touch()
    except OSError as err:
        raise UnusableFolderError(f"{err.filename}: {err.strerror}") from err
    return path


@cache
def _folder(named: str, *others: Path) -> tuple[Path | None, str]:
    try:
        above = private_folder(Path(named).absolute() if named else _user_cache())
        found = private_folder(above / f"loops-{content_digest(_PACKAGES, *others)}")
    except UnusableFolderError as err:
        return None, str(err)
    _remove_old(above)
    return found, ""


def code_cache(source: str = __file__) -> tuple[Path | None, str]:
    """Return the folder for the code of a file, created if necessary; None and why, if there is none.

    It is that of this version, and for a file elsewhere also of the files beside that one.
    `NUMBA_CACHE_DIR` names another folder than the user's cache.
    """
    beside = Path(source).resolve().parent
    others = () if beside.is_relative_to(_PACKAGES) else (beside,)
    return _folder(os.environ.get("NUMBA_CACHE_DIR", ""), *others)


def cache_error() -> str:
    """Return why compiled code is not cached for later processes; empty if it is."""
    return code_cache()[1]


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
