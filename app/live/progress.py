"""Reports the progress of a run: log lines every few seconds, or the status line of a terminal."""

from __future__ import annotations

import logging
import os
import threading
import time
import unicodedata
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Self, TextIO

from nurbseg.app.control.commands import RunState
from nurbseg.common.frame import RGBDFrame

if TYPE_CHECKING:
    from nurbseg.app.recording.recorder import Recorder
    from nurbseg.drivers.process.client import SourceProcess

_log = logging.getLogger(__name__)

#: Erases a line of a terminal.
_ERASE = "\r\x1b[K"
#: Time between two log lines, seconds.
_INTERVAL_S = 5.0
#: Time between updates of the status line, and without a frame until it says so, seconds.
_DRAW_S, _SILENCE_S = 0.25, 2.0
#: Time between two states for the page, seconds.
_TELL_S = 0.1
#: Number of frames over which the status line averages the rate.
_RATE_FRAMES = 15
#: Maximum width of the source's name in the status line, columns.
_SOURCE_COLUMNS = 24


class Progress:
    """Reports the progress of a run in the status line, if there is one, or else in the log.

    `tell` is given the run's state whenever it has changed.
    """

    def __init__(
        self,
        source: SourceProcess,
        recorder: Recorder,
        line: StatusLine | None = None,
        name: str = "",
        *,
        tell: Callable[[RunState], None] = lambda _: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._source, self._recorder = source, recorder
        self._line = line
        self._name = cut(name, _SOURCE_COLUMNS)
        self._clock = clock
        self._tell = tell
        #: What commands decide, and what was told last.
        self._state, self._told = RunState(), RunState()
        self._told_s = float("-inf")
        self._drawing = threading.Lock()
        #: Number of the newest segmented frame.
        self._frame: int | None = None
        self._logged_s = self._drawn_s = clock()
        self._frames = self._late = self._damaged = self._recorded_only = 0
        self._is_first = True
        self._came_s: deque[float] = deque(maxlen=_RATE_FRAMES + 1)
        self._latency = self._found = ""

    def segmented(
        self,
        frame: RGBDFrame,
        leaves: int,
        elapsed_ms: Mapping[str, float],
        *,
        objects: int = 0,
        late: int = 0,
    ) -> None:
        """Report a frame if it is the first or due; `late` frames were too old to be shown."""
        self._frames += 1
        self._damaged = self._source.status.damaged
        self._came_s.append(self._clock())
        self._late = late
        self._frame = frame.index
        latency_ms = elapsed_ms.get("capture_to_labels")
        self._latency = "" if latency_ms is None else f", {latency_ms:.0f} ms"
        self._found = f"{objects} objects" if objects else f"{leaves} segments"
        name = f" ({frame.name})" if frame.name else ""
        took_ms = sum(elapsed_ms.get(stage, 0.0) for stage in ("register", "segment"))
        line = f"frame {frame.index}{name}: {leaves} segment{'s' * (leaves != 1)} in {took_ms:.0f} ms"
        if not self._is_first:
            _log.debug(line)
        if self._is_first:
            _log.info(line)
        elif self._is_due():
            elapsed_s = self._clock() - self._logged_s
            dropped = self._source.replaced
            drops = f", {dropped} overwritten by newer ones" if dropped else ""
            drops += f", {late} too late" if late else ""
            drops += self._recorded()
            read = self._source.status.read
            _log.info("%s; %.1f frames/s, %d read%s", line, self._frames / elapsed_s, read, drops)
        else:
            return
        self._is_first, self._frames, self._logged_s = False, 0, self._clock()

    def recorded(self) -> None:
        """Report the recording if it is due."""
        read = self._source.status.read
        self._damaged = self._source.status.damaged
        self._came_s.extend([self._clock()] * (read - self._recorded_only))
        self._recorded_only = read
        if self._is_due():
            _log.info("%d read%s", read, self._recorded())
            self._logged_s = self._clock()

    def _is_due(self) -> bool:
        """Whether it is time for a log line, where there is no status line."""
        return self._line is None and self._clock() - self._logged_s >= _INTERVAL_S

    def _recorded(self) -> str:
        recording = self._recorder.recording
        if recording is None:
            return ""
        return f", {recording.frames} recorded" + (f", {recording.lost} lost" if recording.lost else "")

    def waiting(self) -> None:
        """Report, if it lasts, that there is no frame."""
        if self._is_due():
            if damaged := self._source.status.damaged - self._damaged:
                _log.warning("no frame, but %d damaged ones in %.0f s", damaged, _INTERVAL_S)
            else:
                _log.info("waiting for a frame")
            self._damaged = self._source.status.damaged
            self._frames, self._logged_s = 0, self._clock()

    def draw(self, state: Callable[[], RunState] = RunState, *, at_once: bool = False) -> None:
        """Show the state of a run, of which `state` returns what commands decide, where that is due.

        Any thread may call this: the newest state is shown last.
        """
        with self._drawing:
            now_s = self._clock()
            self._state = state()
            line_due = self._line is not None and (at_once or now_s - self._drawn_s >= _DRAW_S)
            if not line_due and not at_once and now_s - self._told_s < _TELL_S:
                return
            whole = self._whole(now_s)
            if self._line is not None and line_due:
                self._drawn_s = now_s
                self._line.show(" | ".join(whole.status))
            self._told_s = now_s
            if whole != self._told:
                self._told = whole
                self._tell(whole)

    def end(self) -> None:
        """Show that the run goes on no longer."""
        self._tell(replace(self._whole(self._clock()), ended=True))

    def _whole(self, now_s: float) -> RunState:
        """Return the state with what is measured."""
        source, recording = self._source, self._recorder.recording
        if self._state.paused or not self._came_s or now_s - self._came_s[-1] > _SILENCE_S:
            # The rate is measured anew after a pause.
            self._came_s.clear()
            damaged = source.status.damaged > self._damaged
            silence = "only damaged frames" if damaged else "waiting for a frame"
            activity = "paused" if self._state.paused else silence
        else:
            span_s = self._came_s[-1] - self._came_s[0]
            rate = f"{(len(self._came_s) - 1) / span_s:.1f} frames/s" if span_s > 0 else "first frame"
            activity = f"{rate}{self._latency}"
        return replace(
            self._state,
            source=self._name,
            frame=self._frame,
            activity=activity,
            found=self._found,
            dropped=source.replaced + source.status.damaged,
            late=self._late,
            # Of days, it may have more files than a message has room for.
            recording=None if recording is None else replace(recording, files=()),
        )


def in_foreground(descriptor: int) -> bool:
    """Whether this process may use a terminal: a background process would be stopped."""
    try:
        return os.tcgetpgrp(descriptor) == os.getpgrp()
    except OSError:
        return False


class StatusLine:
    """The last line of a terminal, `stream`; while it is open, the log is written above it."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lock = threading.Lock()
        self._text = ""
        self._is_drawn = False

    def __enter__(self) -> Self:
        self._handlers = [
            handler
            for handler in logging.getLogger().handlers
            if isinstance(handler, logging.StreamHandler) and handler.stream is self._stream
        ]
        for handler in self._handlers:
            handler.setStream(self)
        return self

    def __exit__(self, *_: object) -> None:
        for handler in self._handlers:
            handler.setStream(self._stream)
        self.show("")

    def show(self, text: str) -> None:
        """Replace the line, cut to the width of the terminal."""
        # The terminal may be gone.
        with self._lock, suppress(OSError):
            self._text = text
            self._draw()

    def write(self, text: str) -> None:
        """Write complete lines above."""
        with self._lock:
            self._draw(text)

    def flush(self) -> None:
        """Do nothing: `write` flushes."""

    def _draw(self, above: str = "") -> None:
        """Write everything at once, so that no other output comes in between."""
        ours = in_foreground(self._stream.fileno())
        erased = _ERASE if ours and self._is_drawn else ""
        # The cursor stays at the beginning of the line, so that a viewer's own output overwrites it.
        line = f"{cut(self._text, self._columns() - 1)}\r" if ours and self._text else ""
        self._is_drawn = bool(line)
        self._stream.write(f"{erased}{above}{line}")
        self._stream.flush()

    def _columns(self) -> int:
        try:
            # Some terminals return 0.
            return os.get_terminal_size(self._stream.fileno()).columns or 80
        except OSError:
            return 80


def cut(text: str, columns: int) -> str:
    """Return the beginning of a text that fits, with "?" for characters that cannot be printed."""
    kept = ""
    for character in text:
        is_wide = unicodedata.east_asian_width(character) in ("W", "F")
        columns -= 0 if unicodedata.combining(character) else 2 if is_wide else 1
        if columns < 0:
            break
        kept += character if character.isprintable() else "?"
    return kept
