"""The commands as they are installed: each begins here, before anything else is imported."""

from __future__ import annotations

import signal
from importlib import import_module
from types import ModuleType

_INTERRUPTED = 130


def live() -> int:
    """Run nurbseg-live, which handles signals from when it has begun something to be finished."""
    result: int = _imported("nurbseg.app.command.cli").command()
    return result


def batch() -> int:
    """Run nurbseg-batch."""
    return _interruptible(_imported("nurbseg.app.batch.cli"), "main")


def devices() -> int:
    """Run nurbseg-devices."""
    return _interruptible(_imported("nurbseg.app.devices.cli"), "main")


def evaluation() -> int:
    """Run nurbseg-eval."""
    return _interruptible(_imported("nurbseg.app.evaluation.cli"), "command")


def record() -> int:
    """Run nurbseg-record."""
    return _interruptible(_imported("nurbseg.app.recording.cli"), "main")


def _imported(module: str) -> ModuleType:
    """Import a module; until then, Ctrl-C ends the process without a word, as there is nothing to finish."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return import_module(module)


def _interruptible(module: ModuleType, function: str) -> int:
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        result: int = getattr(module, function)()
    except KeyboardInterrupt:
        return _INTERRUPTED
    return result
