"""A thread that executes the commands of a page or of listeners while frames are segmented."""

import threading
from contextlib import suppress
from typing import Self, TypeAlias

from nurbseg.app.control.commands import Asked
from nurbseg.app.live.control.controls import Controls
from nurbseg.app.live.progress import Progress
from nurbseg.common.process.bounded_queue import BoundedQueue

#: Commands that wait; of more, the oldest are forgotten.
_ASKED_MAX = 100
#: Longest wait for the next one before looking again, seconds.
_TAKE_S = 1.0

CommandQueue: TypeAlias = BoundedQueue[Asked]


def command_queue() -> CommandQueue:
    """Return a queue for the commands of a run."""
    return BoundedQueue(_ASKED_MAX, "drop oldest")


class CommandThread:
    """Executes commands as they come, and shows the state at once: a person does not wait for a frame."""

    def __init__(self, asked: CommandQueue, controls: Controls, progress: Progress) -> None:
        self._asked, self._controls, self._progress = asked, controls, progress
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="commands", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._asked.discard()
        self._thread.join()

    def check(self) -> None:
        """Raise the error of a command, if one has failed."""
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            while not self._asked.finished:
                with suppress(TimeoutError):
                    if (asked := self._asked.take(_TAKE_S)) is not None:
                        self._controls.apply(asked.command, asked.number)
                        self._progress.draw(self._controls.state, at_once=True)
        except BaseException as err:
            # The run raises this.
            self._error = err
