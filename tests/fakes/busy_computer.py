"""Whether other programs take so much of this computer that it cannot keep up with a camera."""

from __future__ import annotations

import os

import pytest

#: Of each processor; a test that uses a camera wants about one and a half itself.
_LOAD_MAX = 2.5


def skip_if_busy(what: str) -> None:
    """Skip the test, saying what went wrong, if that is the fault of other programs."""
    load, processors = os.getloadavg()[0], os.cpu_count() or 1
    if load > _LOAD_MAX * processors:
        pytest.skip(f"too busy a computer: {what}; load {load:.1f} on {processors} processors")


__all__ = ["skip_if_busy"]
