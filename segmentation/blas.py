"""BLAS limited to one thread, so that results do not depend on the number of threads."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@cache
def _libraries() -> ThreadpoolController:
    # NumPy and SciPy each bring their own library; this import loads SciPy's.
    import scipy.linalg.lapack  # noqa: F401

    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS use one thread in this process while the block runs.

    How a product is divided among threads changes its rounding, which can move a point to the other side of a
    cut, and so change the tree. More threads would not be faster: the matrices are small, and on a busy
    computer threads wait for each other far longer than they compute.
    """
    with _libraries().limit(limits=1):
        yield
