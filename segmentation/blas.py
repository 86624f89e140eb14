"""Matrix products on one thread: the same rounding on every computer's number of threads, and no waiting."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _libraries() -> ThreadpoolController:
    # NumPy and SciPy each bring a library of their own; SciPy's is loaded by this import.
    import scipy.linalg.lapack  # noqa: F401

    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS use one thread in this process while the block runs.

    Several threads split a product at places that depend on their number, and round differently there: enough
    to send a point to the other side of a cut, and a tree another way. They also gain nothing here: the
    matrices are small, and on a busy computer waiting for each other takes many times the work.
    """
    with _libraries().limit(limits=1):
        yield
