"""How much was written to a disk, and how much may still be."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path


def free_space(path: Path) -> int:
    """Return how many bytes this user may still write where a file is."""
    return shutil.disk_usage(path.parent).free


def shortage(path: Path, least_mb: int, free_bytes: Callable[[Path], int] = free_space) -> str:
    """Say that too little space is left where a file is; empty where there is enough.

    Parameters
    ----------
    path : Path
        The file.
    least_mb : int
        What must stay free, units of 10^6 bytes.
    free_bytes : callable
        Returns the space that is left, bytes.
    """
    free = free_bytes(path)
    return "" if free >= least_mb * 1_000_000 else f"only {free // 1_000_000} MB of disk space are left"


def megabytes(files: Iterable[Path]) -> float:
    """Return how large files are together, units of 10^6 bytes; one that is gone counts nothing."""
    return round(sum(file.stat().st_size for file in files if file.exists()) / 1e6, 1)
