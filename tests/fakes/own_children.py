"""The processes that this one has started, apart from Python's own helpers."""

from __future__ import annotations

import psutil


def own_children() -> list[psutil.Process]:
    """Return the processes started by what is tested, and still there.

    Python keeps a process for the resources of others, until this one ends.
    """
    children = []
    for child in psutil.Process().children():
        try:
            words = " ".join(child.cmdline())
        except psutil.ZombieProcess:
            words = ""  # has ended, and nobody asked how
        except psutil.NoSuchProcess:
            continue
        if "resource_tracker" not in words:
            children.append(child)
    return children


__all__ = ["own_children"]
