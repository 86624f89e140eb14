"""The process that shows and saves frames, as a handle: started early, spoken to, and ended."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from multiprocessing import Pipe
from pathlib import Path
from types import TracebackType
from typing import Self

from nurbseg.app.view.config import ViewConfig
from nurbseg.app.view.viewer import ViewError, chosen_mode
from nurbseg.drivers.process.start import python_command

#: How long the process may take to end when it was told to, before it is ended; seconds.
_END_S = 0.2


class ViewProcess:
    """Runs `nurbseg.app.view.program`.

    What that does for a frame is Python for the most part, and only one thread of a process runs Python at a
    time: here it would hold up what is computed. Started early, it imports what it needs in the meantime.

    Attributes
    ----------
    words : multiprocessing.connection.Connection
        What goes to and fro: tuples, a word first.
    memory : int
        Descriptor of the memory that frames go through. It has no name anywhere, and so is gone with those
        who hold it, however they end.

    Raises
    ------
    ViewError
        If the process cannot be started.
    """

    def __init__(self) -> None:
        with contextlib.ExitStack() as held:
            try:
                self.memory = os.memfd_create("nurbseg-view")
                held.callback(os.close, self.memory)
                self.words, theirs = Pipe()
                held.callback(self.words.close)
                with theirs:
                    self._process = _started(theirs.fileno(), self.memory)
            except OSError as err:
                raise ViewError(f"the process that shows and saves cannot be started: {err}") from err
            held.pop_all()

    def end(self) -> str:
        """End the process, if it does not by itself, and what it serves; return how it ended."""
        if self._process.returncode is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_END_S)
            # Its web server is of its group, and outlives it where it could not close.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
        code = self._process.wait()
        return f"by signal {-code}" if code < 0 else f"with code {code}"

    def peak_memory_mb(self) -> float:
        """Return the largest resident size that the process has had, 10^6 bytes; 0 where it is not known."""
        try:
            lines = Path(f"/proc/{self._process.pid}/status").read_text().splitlines()
        except OSError:
            return 0.0
        return sum(1024e-6 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))

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


def _started(words: int, memory: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        python_command("nurbseg.app.view.program", str(words), str(memory)),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=[words, memory],
        # Ctrl-C is for this process, which ends the other in its own time.
        start_new_session=True,
    )


def begin_view(config: ViewConfig) -> ViewProcess | None:
    """Start the process that shows and saves, if there is anything to show or save."""
    return None if chosen_mode(config) == "none" and config.save is None else ViewProcess()


__all__ = ["ViewProcess", "begin_view"]
