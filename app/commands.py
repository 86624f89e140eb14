"""The entry points of the installed commands, which import everything else."""

import errno
import os
import signal
import sys
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

_FAILED, _INTERRUPTED = 1, 130


#: What ends a command that writes files as Ctrl-C does: `kill`, the end of a job, and the closed terminal.
ENDS = (signal.SIGTERM, signal.SIGHUP)


def run(
    module: str,
    function: str = "main",
    *,
    on_interrupt: Any = signal.default_int_handler,
    also: tuple[signal.Signals, ...] = (),
) -> int:
    """Run a command.

    Ctrl-C ends the process silently during imports. Then it, and the signals `also` named, do what
    `on_interrupt` says.
    """
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    _open_closed_streams()
    run = getattr(import_module(module), function)
    try:
        for number in (signal.SIGINT, *(each for each in also if signal.getsignal(each) == signal.SIG_DFL)):
            signal.signal(number, on_interrupt)
        code: int = run()
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _INTERRUPTED
    except OSError as err:
        if err.errno not in (errno.EPIPE, errno.ENOSPC):
            raise
        # The reader of standard output, such as `head`, has ended, or its disk is full.
        if err.errno == errno.ENOSPC:
            with suppress(OSError):
                print(f"{Path(sys.argv[0]).name}: error: standard output: {err.strerror}", file=sys.stderr)
        # The flush at exit would fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _FAILED
    return code


def _open_closed_streams() -> None:
    """Open standard streams that are closed: files would take their numbers, and get what is printed."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))


#: nurbseg-live handles signals itself once there is something to finish.
live = partial(run, "nurbseg.app.command.live_command", "command", on_interrupt=signal.SIG_DFL)
batch = partial(run, "nurbseg.app.batch.batch_command", also=ENDS)
devices = partial(run, "nurbseg.app.devices.devices_command")
record = partial(run, "nurbseg.app.recording.record_command", also=ENDS)
