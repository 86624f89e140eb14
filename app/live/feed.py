"""Commands, by keys of a terminal, lines of standard input or a page, and the frames between them."""

from __future__ import annotations

import logging
import os
import select
import statistics
import string
import sys
import termios
import time
import tty
from collections import deque
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager, closing, nullcontext, suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

from nurbseg.app.control.commands import KEYS, RunState
from nurbseg.app.live.controls import Controls
from nurbseg.app.live.interruption import Interruption
from nurbseg.app.live.progress import Progress, StatusLine, in_foreground
from nurbseg.app.settings.app_config import Control
from nurbseg.common.errors import EndOfRecordingError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.process.client import SourceProcess

if TYPE_CHECKING:
    from nurbseg.segmentation.points.depth_preparation import DepthPreparation

_log = logging.getLogger(__name__)

#: Time between two checks for commands and whether the run was interrupted, seconds.
_FRAME_S = 0.05
#: Number of periods whose median gives the rate of the source.
_PERIODS = 15


class Console:
    """Reads commands from a file descriptor.

    With `keys` it is a terminal in which each key is a command; otherwise each line is one.
    """

    def __init__(self, descriptor: int, *, keys: bool) -> None:
        self._descriptor = descriptor
        self._keys = keys
        self._commands: deque[str] = deque()
        self._unfinished = ""
        self._ended = False

    def __enter__(self) -> Self:
        self._before: list[Any] | None = None
        self._begin_keys()
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None and in_foreground(self._descriptor):
            termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)

    def _begin_keys(self) -> None:
        """Get keys as they are pressed, which shells end whenever the program is in the background."""
        if self._keys and in_foreground(self._descriptor):
            modes = termios.tcgetattr(self._descriptor)
            if modes[3] & termios.ICANON:
                self._before = modes
                # At once: a terminal that is frozen (Ctrl-S) never ends its output. Earlier keys are kept.
                tty.setcbreak(self._descriptor, termios.TCSANOW)

    def take(self) -> str | None:
        """Return the next command, or None; never waits."""
        if not self._commands and not self._ended:
            self._read()
        return self._commands.popleft() if self._commands else None

    def _read(self) -> None:
        if os.isatty(self._descriptor) and not in_foreground(self._descriptor):
            return
        self._begin_keys()
        if not select.select([self._descriptor], [], [], 0.0)[0]:
            return
        text = ""
        with suppress(OSError):
            text = os.read(self._descriptor, 1024).decode(errors="replace")
        self._ended = not text
        if not self._keys:
            # The last line may have no end.
            *lines, self._unfinished = (self._unfinished + (text or "\n")).split("\n")
            self._commands.extend(filter(None, map(str.strip, lines)))
            return
        for key in text:
            if key in string.digits or (key == "." and self._unfinished.isdecimal()):
                self._unfinished += key
                continue
            if command := KEYS.get(key):
                self._commands.append(command + self._unfinished if command.endswith(" ") else command)
            self._unfinished = ""


def open_console(control: Control) -> Console | None:
    """Return the console that a setting asks for; None if there is none."""
    if control == "lines":
        return Console(sys.stdin.fileno(), keys=False)
    return Console(sys.stdin.fileno(), keys=True) if in_terminal(control) else None


def in_terminal(control: Control) -> bool:
    """Whether a user controls the run from a terminal."""
    return control == "auto" and sys.stdin.isatty() and sys.stderr.isatty()


def open_status_line(control: Control) -> AbstractContextManager[StatusLine | None]:
    """Return the status line; None with --quiet, or without a suitable terminal."""
    wanted = in_terminal(control) and _log.isEnabledFor(logging.INFO) and os.environ.get("TERM") != "dumb"
    return StatusLine(sys.stderr) if wanted else nullcontext()


class Feed:
    """The frames of a run; taking one updates the progress, and raises if a signal came.

    Every frame goes through `preparation`; the first one without any depth is logged. Unless it `takes`
    frames, they are only read by the source process, which records them.
    """

    def __init__(
        self, source: SourceProcess, progress: Progress, interruption: Interruption, *, takes: bool = True
    ) -> None:
        self.progress = progress
        #: Measured frame rate of the source; 0 if unknown.
        self.source_hz = 0.0
        self.preparation: DepthPreparation | None = None
        self.takes = takes
        self._source, self._interruption = source, interruption
        self._periods_s: deque[float] = deque(maxlen=_PERIODS)
        self._last: RGBDFrame | None = None
        self._warned_empty = False

    def controlled(self, control: Control, controls: Controls) -> Generator[RGBDFrame, None, None]:
        """Yield frames, and the last one again if settings change in a pause; a snapshot precedes the end."""
        last: RGBDFrame | None = None
        segmented_by = controls.config
        # At once: a person does not wait for a frame.
        controls.changed = lambda: self.progress.draw(controls.state, at_once=True)
        with open_console(control) or nullcontext() as console, closing(controls):
            if console is not None and control == "auto":
                _log.info("h lists the keys, q quits")
            for frame in self.frames(controls):
                for command in () if console is None else iter(console.take, None):
                    controls.apply(command)
                if controls.error is not None:
                    raise controls.error
                controls.recorder.log_finished()
                if controls.is_over or (controls.ended and not controls.wanted):
                    return
                if frame is None and last is not None and (self._source.paused or controls.ended):
                    wanted = controls.wanted or segmented_by is not controls.config
                    frame = replace(last, arrived_s=time.monotonic()) if wanted else None
                if frame is not None:
                    last, segmented_by = frame, controls.config
                    yield last

    def frames(self, controls: Controls | None = None) -> Iterator[RGBDFrame | None]:
        """Yield frames until the source ends, and None from time to time if there is none or in a pause."""
        while True:
            self._interruption.check()
            self.progress.draw(RunState if controls is None else controls.state)
            try:
                yield self._next()
            except EndOfRecordingError:
                return

    def _next(self) -> RGBDFrame | None:
        """Return the next frame; None if none came for a moment."""
        if not self.takes:
            self._source.wait(_FRAME_S)
            self.progress.recorded()
            return None
        try:
            frame = self._source.read(_FRAME_S)
        except FrameTimeoutError:
            if not self._source.paused:
                self.progress.waiting()
            return None
        self._take_period(frame)
        if self.preparation is not None:
            frame = self.preparation.prepared(frame)
        if not self._warned_empty and not frame.depth_mm.any():
            self._warned_empty = True
            _log.warning(
                "frame %d: no pixel has depth; check --depth-scale, --range-min, --range-max and --crop, or "
                "what the camera sees",
                frame.index,
            )
        return frame

    def _take_period(self, frame: RGBDFrame) -> None:
        """Add the period since the frame before to the statistics, allowing for frames in between."""
        last, self._last = self._last, frame
        if last is None or frame.jumps != last.jumps or frame.index <= last.index:
            return
        assert frame.arrived_s is not None
        assert last.arrived_s is not None
        self._periods_s.append((frame.arrived_s - last.arrived_s) / (frame.index - last.index))
        if len(self._periods_s) == _PERIODS:
            self.source_hz = 1.0 / max(statistics.median(self._periods_s), 1e-9)


def wait_for_quit(control: Control, interruption: Interruption) -> None:
    """Wait for the command to quit or Ctrl-C; other commands no longer have an effect."""
    with open_console(control) or nullcontext() as console:
        how = "Ctrl-C ends" if console is None else "q or Ctrl-C ends"
        _log.info("all frames are shown; %s the server", how)
        interruption.wait(lambda: console is not None and console.take() == "quit")
