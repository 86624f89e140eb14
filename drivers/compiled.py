"""Loops over pixels as machine code: compiled when first called, kept on disk, run without Python's lock."""

import hashlib
import os
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, ParamSpec, TypeAlias, TypeVar

import numba
import numpy as np
from numba.core import config
from numpy.typing import NDArray

_P = ParamSpec("_P")
_R = TypeVar("_R")

#: Arrays that compiled functions take, by the type of their elements, as Numba abbreviates it.
F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
I8: TypeAlias = NDArray[np.int8]
I32: TypeAlias = NDArray[np.int32]
I64: TypeAlias = NDArray[np.int64]
Intp: TypeAlias = NDArray[np.intp]
U8: TypeAlias = NDArray[np.uint8]
U16: TypeAlias = NDArray[np.uint16]
Bool: TypeAlias = NDArray[np.bool_]

#: What the compiler may reorder: sums, and products within them. Comparisons know a NaN and an infinity, but
#: `isfinite` of a sum does not: it looks at the number less itself, which is then 0.
_FASTMATH = {"reassoc", "contract", "nsz"}
#: What marks a file whose functions are compiled.
_MARKS = (b"\n@compiled", b"\n@inlined")
_PACKAGES = Path(__file__).resolve().parent.parent
#: Folders of machine code that are kept, those used last: of this version and of some before it.
_KEPT = 3


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function of arrays and numbers for the types that it is called with.

    The code is kept beside the package, or in the user's cache directory where that cannot be written, so
    that only the first call on a computer waits for the compiler. It is kept by the content of all files that
    hold compiled functions: these may call each other, and read each other's constants. Indices are not
    checked.
    """
    # Numba makes this attribute when it reads its environment variables, and chooses a folder here and now.
    before: str = config.CACHE_DIR  # type: ignore[attr-defined]
    folder = _folder(before)
    config.CACHE_DIR = str(folder)  # type: ignore[attr-defined]
    try:
        return _compiled(function, cache=folder is not None)
    except RuntimeError:
        # It cannot be kept: each process compiles for itself.
        return _compiled(function, cache=False)
    finally:
        config.CACHE_DIR = before  # type: ignore[attr-defined]


def inlined(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a step of compiled functions into each of them.

    A call hands arrays over one by one, which can cost more than a short step itself.
    """
    return _compiled(function, forceinline=True)


def inlined_once(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a step into the one compiled function that calls it, and nothing on its own.

    Compiled on its own, a long step is optimized twice: once alone and once as a part of its caller.
    """
    return _compiled(function, inline="always")


def _compiled(function: Callable[_P, _R], **options: Any) -> Callable[_P, _R]:
    options |= {
        "nogil": True,
        "error_model": "numpy",
        "fastmath": _FASTMATH,
        # Nothing calls a function through a pointer: that saves a twentieth of the compiler's time.
        "no_cfunc_wrapper": True,
    }
    decorated: Callable[_P, _R] = numba.njit(**options)(function)
    return decorated


@cache
def _folder(wanted: str) -> Path | None:
    """Return the folder of this version's code, created if necessary; None if none can be written."""
    name = f"loops-{content_digest(_PACKAGES)}"
    cache_home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    beside = Path(__file__).parent / "__pycache__"
    for above in (wanted,) if wanted else (beside, f"{cache_home}/nurbseg"):
        try:
            folder = Path(above).expanduser() / name
            folder.mkdir(parents=True, exist_ok=True)
            # Says when it was last used, and fails where it cannot be written.
            (folder / "used").touch()
        except (OSError, RuntimeError):  # the latter where the user has no home, as in some containers
            continue
        _remove_old(folder.parent)
        return folder
    return None


def keeps_code() -> bool:
    """Whether compiled code is kept for later processes."""
    return _folder(config.CACHE_DIR) is not None  # type: ignore[attr-defined]


def content_digest(packages: Path) -> str:
    """Return a digest of all files with compiled functions in ``drivers``, ``segmentation`` and ``app``."""
    digest = hashlib.sha256()
    for package in ("app", "drivers", "segmentation"):
        for path in sorted((packages / package).rglob("*.py")):
            content = path.read_bytes()
            if any(mark in content for mark in _MARKS):
                digest.update(path.relative_to(packages).as_posix().encode() + b"\0" + content)
    return digest.hexdigest()[:16]


def _remove_old(above: Path) -> None:
    """Remove all folders of code but those that were used last."""

    def used_ns(folder: Path) -> int:
        try:
            return (folder / "used").stat().st_mtime_ns
        except OSError:
            return 0

    for old in sorted(above.glob("loops-*"), key=used_ns, reverse=True)[_KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
