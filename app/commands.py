"""The entry points of the installed commands, which import everything else."""

import signal
from importlib import import_module
from typing import Any

_INTERRUPTED = 130


def live() -> int:
    """Run nurbseg-live, which handles signals itself once there is something to finish."""
    return _run("nurbseg.app.command.cli", "command", on_interrupt=signal.SIG_DFL)


def batch() -> int:
    """Run nurbseg-batch."""
    return _run("nurbseg.app.batch.cli")


def devices() -> int:
    """Run nurbseg-devices."""
    return _run("nurbseg.app.devices.cli")


def evaluation() -> int:
    """Run nurbseg-eval."""
    return _run("nurbseg.app.evaluation.cli", "command")


def record() -> int:
    """Run nurbseg-record."""
    return _run("nurbseg.app.recording.cli")


def _run(module: str, function: str = "main", *, on_interrupt: Any = signal.default_int_handler) -> int:
    """Run a command; Ctrl-C ends the process silently during imports, and then as `on_interrupt` says."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    run = getattr(import_module(module), function)
    try:
        signal.signal(signal.SIGINT, on_interrupt)
        code: int = run()
    except KeyboardInterrupt:
        return _INTERRUPTED
    return code
