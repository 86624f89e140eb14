"""The process that shows and saves frames, started early: it imports what it needs in the meantime.

What it does for a frame is Python for the most part, and only one thread of a process runs Python at a time:
in the process that segments it would hold up what is computed.
"""

from __future__ import annotations

from nurbseg.app.view.config import ViewConfig
from nurbseg.app.view.viewer import ViewError, chosen_mode
from nurbseg.drivers.process.child import ChildProcess

#: Frames on their way to it: one is filled in while one is read.
_SLOTS = 2


def begin_view(config: ViewConfig) -> ChildProcess | None:
    """Start the process that shows and saves; None if there is nothing to show or save.

    Raises
    ------
    ViewError
        If it cannot be started.
    """
    if chosen_mode(config) == "none" and config.save is None:
        return None
    try:
        return ChildProcess("nurbseg.app.view.program", slots=_SLOTS, quiet=False)
    except OSError as err:
        raise ViewError(f"the process that shows and saves cannot be started: {err}") from err


__all__ = ["begin_view"]
