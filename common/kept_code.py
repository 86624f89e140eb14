"""Which code runs: where it is kept that nobody else can put any, and libraries without foreign settings."""

import grp
import hashlib
import os
import pwd
import shutil
import stat
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType

#: The file that a module looks for in the working folder, and where it looks instead, beside its own source.
#: The settings can name programs and folders of code, and anybody may have left the file there.
_FILES = {
    "numba.core.config": (".numba_config.yaml", ".numba_config.yaml"),
    "matplotlib": ("matplotlibrc", "mpl-data/matplotlibrc"),
}


class _Loader(SourceFileLoader):
    """Loads a module with another name in place of its file's."""

    def get_code(self, fullname: str) -> CodeType | None:
        code = super().get_code(fullname)
        name, _ = _FILES[fullname]
        return code and _replaced(code, name, own_file(fullname, self.path))


def _replaced(code: CodeType, old: str, new: str) -> CodeType:
    """Return code with another text in place of a constant, in nested functions too."""
    constants = (
        _replaced(const, old, new) if isinstance(const, CodeType) else new if const == old else const
        for const in code.co_consts
    )
    return code.replace(co_consts=tuple(constants))


def own_file(module: str, source: str) -> str:
    """Return where a module, whose source is at this path, looks instead."""
    return str(Path(source).resolve().parent / _FILES[module][1])


class _Finder(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = PathFinder.find_spec(fullname, path) if fullname in _FILES else None
        if spec is not None and spec.origin is not None:
            spec.loader = _Loader(fullname, spec.origin)
        return spec


@contextmanager
def left_out() -> Iterator[None]:
    """Import within the block without such files; a module that is imported already stays as it is."""
    finder = _Finder()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


#: What marks a file whose functions are compiled.
_MARKS = (b"\n@compiled", b"\n@inlined")
#: Packages with such files.
_WITH_LOOPS = ("common", "drivers", "library", "recordings", "segmentation")
_PACKAGES = Path(__file__).resolve().parent.parent
#: What to do where the code is not kept.
KEEP_CODE = "set XDG_CACHE_HOME to a folder that you, and nobody else, can write"
#: Folders of machine code that are kept, those used last: of this version and of some before it.
_KEPT = 3
#: A folder that was used within this time is kept as well: a process may still use it.
_IN_USE_S = 24 * 3600
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class UnusableFolderError(Exception):
    """A folder cannot be used for code; the message names the file and says why."""


def user_cache() -> Path:
    """Return the user's cache folder, `XDG_CACHE_HOME` or ``~/.cache``.

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
    return folder


def code_folder(above: Path, *names: str) -> Path:
    """Return the folder of these names in another one, all of them created if necessary, for this user only.

    Whoever can write there runs code in this process. So the folder itself, the one above it and all that
    it holds must belong to this user or to the system, and nobody else may write them. The same holds
    further up, where a folder that everybody may write, such as ``/tmp``, protects what others create in it.

    Raises UnusableFolderError, whose message says what is wrong, if that is not so or the folder cannot be
    written.
    """
    try:
        # From here on without links, which somebody could change.
        above = above.expanduser().resolve()
        for parent in (above, *above.parents):
            _check(parent, protects=parent != above)
        for parent in (*reversed(above.parents), above):
            if not parent.is_dir():
                parent.mkdir(mode=0o700, exist_ok=True)
        folder = above
        for name in names:
            folder = folder / name
            folder.mkdir(mode=0o700, exist_ok=True)
            _check(folder)
        closed = not folder.stat().st_mode & 0o077
        for path in _content(folder):
            _check(path, closed=closed)
        # Says when it was last used, and fails where it cannot be written.
        (folder / "used").touch()
    except OSError as err:
        raise UnusableFolderError(f"{err.filename}: {err.strerror}") from err
    except RuntimeError as err:
        raise UnusableFolderError(f"{above}: {err}") from err  # no such home, or a link to itself
    return folder


def _check(path: Path, *, protects: bool = False, closed: bool = False) -> None:
    """Raise UnusableFolderError if somebody else can write a file or folder; one that is absent is fine.

    A folder that `protects` may be open to all if it keeps its entries from being replaced. What lies in a
    folder that is `closed` to others may have any mode.
    """
    try:
        status = path.lstat()
    except FileNotFoundError:
        return
    # In a container, the system's folders may belong to a user that is unknown there.
    system = {0, Path("/").stat().st_uid}
    if status.st_uid not in {*system, os.geteuid()}:
        raise UnusableFolderError(f"{path}: belongs to another user")
    if stat.S_ISLNK(status.st_mode):
        raise UnusableFolderError(f"{path}: is a link")
    writers = status.st_mode & _OTHERS_WRITE
    if writers == stat.S_IWGRP and _is_own_group(status.st_gid):
        return
    sticky = protects and status.st_uid in system and status.st_mode & stat.S_ISVTX
    if writers and not closed and not sticky:
        raise UnusableFolderError(f"{path}: other users can write it (chmod go-w closes it)")


def _is_own_group(group: int) -> bool:
    """Whether a group is this user's alone, as on systems where each user has one of the same name."""
    try:
        user, entry = pwd.getpwuid(os.geteuid()), grp.getgrgid(group)
    except KeyError:
        return False
    # Container images make many users members of group 0.
    alone = entry.gr_name == user.pw_name and set(entry.gr_mem) <= {user.pw_name}
    return group != 0 and group == user.pw_gid and alone


def _content(folder: Path) -> Iterator[Path]:
    with os.scandir(folder) as entries:
        for entry in entries:
            yield Path(entry.path)
            if entry.is_dir(follow_symlinks=False):
                yield from _content(Path(entry.path))


@cache
def _folder(wanted: str, *others: Path) -> tuple[Path | None, str]:
    name = f"loops-{content_digest(_PACKAGES, *others)}"
    beside = Path(wanted or Path(__file__).parent / "__pycache__")
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
