"""The process that shows and saves frames, as a handle: started early, spoken to, and ended."""

from __future__ import annotations

import os
import subprocess
import sys
from multiprocessing import Pipe
from types import TracebackType
from typing import Self

from nurbseg.app.view_config import ViewConfig
from nurbseg.app.viewer_process import chosen_mode

#: How long the process may take to end when it was told to, before it is ended; seconds.
_END_S = 0.2


class ViewProcess:
    """Runs `nurbseg.app.view_program`.

    What that does for a frame is Python for the most part, and only one thread of a process runs Python at a
    time: here it would hold up what is computed. Started early, it imports what it needs in the meantime.

    Attributes
    ----------
    words : multiprocessing.connection.Connection
        What goes to and fro: tuples, a word first.
    memory : int
        Descriptor of the memory that frames go through.
    """

    def __init__(self) -> None:
        self.memory = os.memfd_create("nurbseg-view")
        self.words, theirs = Pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "nurbseg.app.view_program", str(theirs.fileno()), str(self.memory)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=[theirs.fileno(), self.memory],
            # Ctrl-C is for this process, which ends the other in its own time.
            start_new_session=True,
        )
        theirs.close()

    def end(self) -> str:
        """End the process, if it does not by itself; return how it ended."""
        try:
            code = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        return f"by signal {-code}" if code < 0 else f"with code {code}"

    def close(self) -> None:
        """End the process and let go of what was shared with it; safe to call twice."""
        if not self.words.closed:
            self.end()
            self.words.close()
            os.close(self.memory)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def begin_view(config: ViewConfig) -> ViewProcess | None:
    """Start the process that shows and saves, if there is anything to show or save."""
    return None if chosen_mode(config) == "none" and config.save is None else ViewProcess()


__all__ = ["ViewProcess", "begin_view"]
