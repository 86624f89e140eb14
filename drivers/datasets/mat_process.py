"""The process in which MATLAB files are read, as seen from here."""

from __future__ import annotations

import time
from pathlib import Path

from nurbseg.drivers.datasets.mat_program import CODEC, Answer, MatForm, Request
from nurbseg.drivers.errors import BackendMissingError, FrameFormatError, quoted
from nurbseg.drivers.process.channel import Channel, ChannelClosedError
from nurbseg.drivers.process.child import ChildProcess, how_it_ended

#: Longest wait for an answer, seconds; the first comes after the libraries are loaded.
_ANSWER_S = 60.0
#: A process whose channel is closed ends within this time, seconds.
_END_S = 5.0


class MatProcess:
    """Reads MATLAB files; started on use, and again after a file that ended it."""

    def __init__(self) -> None:
        self._running: tuple[ChildProcess, Channel] | None = None

    def read(self, path: Path, form: MatForm, index: int | None = None) -> Answer:
        """Return what the program answers; without a frame of the labelled set, the shapes of the sets.

        Raises FrameFormatError if the file cannot be used, or has ended the process; BackendMissingError if a
        library that it needs is not installed.
        """
        if self._running is None:
            child = ChildProcess("nurbseg.drivers.datasets.mat_program", slots=1)
            self._running = child, child.connect(CODEC)
        child, channel = self._running
        deadline_s = time.monotonic() + _ANSWER_S
        answer = None
        try:
            channel.send(Request(str(path.absolute()), form, index))
            while not isinstance(answer, Answer) and (left_s := deadline_s - time.monotonic()) > 0:
                answer = channel.receive(left_s)
        except ChannelClosedError:
            how = how_it_ended(child.end(_END_S))
            self.close()
            raise FrameFormatError(f"{path}: cannot be read: the process that reads it {how}") from None
        if not isinstance(answer, Answer):
            self.close()
            raise FrameFormatError(f"{path}: cannot be read: it took over {_ANSWER_S:.0f} s")
        if answer.missing:
            raise BackendMissingError(
                f"{path}: {answer.missing} is needed to read it: pip install {answer.missing}"
            )
        if answer.error:
            raise FrameFormatError(f"{path}: {quoted(answer.error)[1:-1]}")
        return answer

    def close(self) -> None:
        """End the process; safe to call twice."""
        running, self._running = self._running, None
        if running is not None:
            running[0].close()
