"""How much was written to a disk, and how much may still be."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path


def free_space(path: Path) -> int:
    """Return how many bytes this user may still write where a file is."""
    return shutil.disk_usage(path.parent).free


def shortage(free_bytes: int, least_mb: int) -> str:
    """Say that too little space is left, of which so many units of 10^6 bytes must stay; else nothing."""
    enough = free_bytes >= least_mb * 1_000_000
    return "" if enough else f"only {free_bytes // 1_000_000} MB of disk space are left"


def megabytes(files: Iterable[Path]) -> float:
    """Return how large files are together, units of 10^6 bytes; one that is gone counts nothing."""
    return round(sum(file.stat().st_size for file in files if file.exists()) / 1e6, 1)
