"""How a program of ours is started in a process of its own."""

from __future__ import annotations

import sys


def python_command(module: str, *words: str) -> list[str]:
    """Return the command that runs a module as a program of its own.

    Parameters
    ----------
    module : str
        Name of the module, as ``nurbseg.app.devices.cli``.
    *words : str
        Its arguments.

    Returns
    -------
    list of str
        With ``-P``: Python would otherwise look for modules in the current folder first, and run what a
        stranger called ``json.py`` there.
    """
    return [sys.executable, "-P", "-m", module, *words]


__all__ = ["python_command"]
