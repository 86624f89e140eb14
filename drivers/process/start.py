"""How a program is started in a process of its own."""

from __future__ import annotations

import os
import sys

#: Asks Linux for the end of this process with that of its parent (PR_SET_PDEATHSIG), and becomes the program.
_BECOME = """\
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGKILL)
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.argv[2], sys.argv[2:])
"""


def python_command(module: str, *words: str) -> list[str]:
    """Return the command that runs a module, such as ``nurbseg.app.devices.cli``, as a program of its own.

    With ``-P``: Python would otherwise look for modules in the current folder first, and run what a stranger
    called ``json.py`` there.
    """
    return [sys.executable, "-P", "-m", module, *words]


def dying_with_parent(command: list[str]) -> list[str]:
    """Return a command that does the same, but is killed when the thread that starts it ends.

    It is for programs that cannot take care of that themselves.
    """
    return [sys.executable, "-I", "-S", "-c", _BECOME, str(os.getpid()), *command]
