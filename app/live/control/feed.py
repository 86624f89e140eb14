"""Takes frames from the queue, and executes commands between them."""

import logging
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import chain

from nurbseg.app.live.capture import Captured, CaptureThread
from nurbseg.app.live.control.console import open_console
from nurbseg.app.live.control.controls import Controls
from nurbseg.app.live.interruption import Interruption
from nurbseg.app.live.progress import Progress
from nurbseg.app.settings.app_config import Control
from nurbseg.drivers.player import PAUSE_LOOK_S, Player

_log = logging.getLogger(__name__)

#: Time between two checks for commands and whether the run was interrupted, seconds.
_TAKE_TIMEOUT_S = 0.05


@dataclass(frozen=True, slots=True)
class Feed:
    """The captured frames of a run; taking one updates the progress, and raises if a signal came.

    `asked` are functions that yield the commands of others than the console since their last call.
    """

    player: Player
    capture: CaptureThread
    progress: Progress
    interruption: Interruption
    asked: Sequence[Callable[[], Iterable[str]]] = ()

    def controlled(self, control: Control, controls: Controls) -> Generator[Captured, None, None]:
        """Yield frames, and the last one again if settings change in a pause; a snapshot precedes the end."""
        last: Captured | None = None
        segmented_by = controls.config
        with open_console(control) or nullcontext() as console:
            if console is not None and control == "auto":
                _log.info("h lists the keys, q quits")
            for captured in self.captured(controls):
                typed = () if console is None else iter(console.take, None)
                if commands := [*typed, *chain.from_iterable(each() for each in self.asked)]:
                    for command in commands:
                        controls.apply(command)
                    self.progress.draw(controls.state(), at_once=True)
                controls.recorder.log_finished()
                if controls.is_over or (controls.ended and not controls.wants_frame):
                    return
                if captured is None and last is not None and (self.player.paused or controls.ended):
                    wanted = controls.wants_frame or segmented_by is not controls.config
                    captured = replace(last, arrived_s=time.monotonic()) if wanted else None
                if captured is None:
                    continue
                last, segmented_by = captured, controls.config
                yield last

    def captured(self, controls: Controls | None = None) -> Iterator[Captured | None]:
        """Yield frames until the source ends, and None from time to time if there is none or in a pause."""
        while True:
            self.interruption.check()
            self.progress.draw(None if controls is None else controls.state())
            if self.player.waits:
                time.sleep(PAUSE_LOOK_S)
                yield None
                continue
            try:
                captured = self.capture.frames.take(_TAKE_TIMEOUT_S)
            except TimeoutError:
                self.progress.waiting()
                yield None
                continue
            if captured is None:
                return
            if self.player.takes(captured.frame):
                yield captured


def wait_for_quit(control: Control, interruption: Interruption) -> None:
    """Wait for the command to quit or Ctrl-C; other commands no longer have an effect."""
    with open_console(control) or nullcontext() as console:
        how = "Ctrl-C ends" if console is None else "q or Ctrl-C ends"
        _log.info("all frames are shown; %s the server", how)
        interruption.wait(lambda: console is not None and console.take() == "quit")
