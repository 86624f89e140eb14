"""Versions of installed packages."""

from __future__ import annotations

import platform
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version

_PACKAGES = ("nurbseg", "numpy", "scipy", "opencv-python-headless", "rerun-sdk", "mcap")


def versions(packages: Iterable[str] = _PACKAGES) -> dict[str, str]:
    """Return the versions of Python, the platform and the installed packages."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in packages:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found
