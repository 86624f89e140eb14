"""Limits the threads of numeric libraries."""

import os
from collections.abc import MutableMapping

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread_for_products(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let matrix products use one thread, unless the user has set another number.

    The segmentation's matrices are small: several threads take longer than one, and much longer if the camera
    or the viewer needs the processor. Call this before numpy is imported.
    """
    if not any(name in environment for name in _VARIABLES):
        for name in _VARIABLES:
            environment[name] = "1"
