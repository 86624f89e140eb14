"""Sizes of files and free disk space."""

import shutil
from collections.abc import Iterable
from pathlib import Path


def free_space(path: Path) -> int:
    """Return the free space for a file, bytes."""
    return shutil.disk_usage(path.parent).free


def shortage(free_bytes: int, least_mb: int) -> str:
    """Return a message if less than `least_mb` (10^6 bytes) is free, or an empty text."""
    enough = free_bytes >= least_mb * 1_000_000
    return "" if enough else f"only {free_bytes // 1_000_000} MB of disk space are left"


def megabytes(files: Iterable[Path]) -> float:
    """Return the total size of existing files, 10^6 bytes."""
    return round(sum(file.stat().st_size for file in files if file.exists()) / 1e6, 1)
