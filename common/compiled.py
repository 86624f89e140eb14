"""Loops over pixels as machine code: compiled when first called, kept on disk, run without Python's lock."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, ParamSpec, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.code_cache import code_cache, ignored_yaml

with ignored_yaml():
    # Everything of Numba comes from here, so that it is not imported in another way before.
    import numba
    from numba import from_dtype as from_dtype
    from numba import literal_unroll as literal_unroll
    from numba import types as types
    from numba.core import config
    from numba.core import event as event

# A program may have imported it before, and it looks for the file again whenever it compiles.
config._config_fname = os.devnull
with suppress(RuntimeError):  # where that program uses another number of threads already
    config.reload_config()  # type: ignore[no-untyped-call]

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
U32: TypeAlias = NDArray[np.uint32]
Bool: TypeAlias = NDArray[np.bool_]

#: What the compiler may reorder: sums, and products within them. Comparisons know a NaN and an infinity, but
#: `isfinite` of a sum does not: it looks at the number less itself, which is then 0.
_FASTMATH = {"reassoc", "contract", "nsz"}


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function of arrays and numbers for the types that it is called with.

    The code is cached in a folder that only this user can enter, so that only the first call on a computer
    waits for the compiler: see `nurbseg.common.code_cache`. Its key is the content of all files that hold
    compiled functions: these may call each other, and read each other's constants. Indices are not checked.
    """
    folder, _ = code_cache(function.__code__.co_filename)
    if folder is None or config.DISABLE_JIT:  # type: ignore[attr-defined]
        return _compiled(function)
    # Numba chooses a folder here and now; how, it may have read from the working folder in a program that
    # imported it before.
    names = {"CACHE_DIR": str(folder), "CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
    before = {name: getattr(config, name, "") for name in names}
    vars(config).update(names)
    try:
        decorated = _compiled(function, cache=True)
    except RuntimeError:
        # It cannot be kept: each process compiles for itself.
        return _compiled(function)
    finally:
        vars(config).update(before)
    chosen = getattr(getattr(decorated, "stats", None), "cache_path", folder)
    if not Path(chosen).is_relative_to(folder):
        return _compiled(function)
    _keep_if_possible(decorated)
    return decorated


def _keep_if_possible(decorated: Any) -> None:
    """Let a function run where its code can no longer be read or kept, as on a full disk."""
    kept = decorated._cache
    load, save = kept.load_overload, kept.save_overload

    def load_overload(*words: Any) -> Any:
        with suppress(OSError):
            return load(*words)
        return None

    def save_overload(*words: Any) -> None:
        with suppress(OSError):
            save(*words)

    kept.load_overload, kept.save_overload = load_overload, save_overload


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
