"""Loops over pixels as machine code: compiled when first called, kept on disk, run without Python's lock."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import numba

_P = ParamSpec("_P")
_R = TypeVar("_R")

#: What the compiler may reorder: sums, and products within them. Comparisons know a NaN and an infinity, but
#: `isfinite` of a sum does not: it looks at the number less itself, which is then 0.
_FASTMATH = {"reassoc", "contract", "nsz"}


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a function of arrays and numbers for the types that it is called with.

    The code is kept beside the source file, or in the user's cache directory where that cannot be written, so
    that only the first call on a computer waits for the compiler. What is kept is held against the source
    file of the function alone: a compiled function calls compiled functions, and reads constants, of its own
    file only; others are handed to it. Indices are not checked.

    Parameters
    ----------
    function : callable
        Of what Numba compiles.

    Returns
    -------
    callable
        The same, compiled.
    """
    try:
        return _compiled(function, cache=True)
    except RuntimeError:
        # Nowhere to keep it: each process compiles for itself.
        return _compiled(function, cache=False)


def inlined(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a step of compiled functions of the same file into each of them.

    A call hands arrays over one by one, which can cost more than a short step itself.
    """
    return numba.njit(nogil=True, error_model="numpy", fastmath=_FASTMATH, forceinline=True)(function)


def _compiled(function: Callable[_P, _R], *, cache: bool) -> Callable[_P, _R]:
    return numba.njit(cache=cache, nogil=True, error_model="numpy", fastmath=_FASTMATH)(function)


__all__ = ["compiled", "inlined"]
