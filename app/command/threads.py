"""How many threads the numeric libraries start."""

from __future__ import annotations

import os
from collections.abc import MutableMapping

_VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread_for_products(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let matrix products use one thread, unless the user has set another number.

    The segmentation's matrices are small: threads that wait for each other at every product take longer
    than one, and many times longer where the camera, the viewer or anything else wants the processor. This
    has an effect only before numpy is imported.
    """
    if not any(name in environment for name in _VARIABLES):
        for name in _VARIABLES:
            environment[name] = "1"
