"""A view that is shown and saved by a process of its own, and what goes to and fro."""

from __future__ import annotations

import logging
import pickle
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from types import TracebackType
from typing import Any, Self

from nurbseg.app.live.report import versions
from nurbseg.app.live.worker import FrameResult
from nurbseg.app.view.config import ViewConfig
from nurbseg.app.view.drawing.drawing import drawn
from nurbseg.app.view.drawing.frame import Moment
from nurbseg.app.view.memory import SLOTS, SharedSlots
from nurbseg.app.view.outbox import Outbox
from nurbseg.app.view.process import ViewProcess
from nurbseg.app.view.viewer import FILE_CLOSE_S, FILE_PATIENCE_S, ViewError
from nurbseg.drivers.frame import Calibration
from nurbseg.segmentation.config import SegmentationConfig

#: Frames that may wait to be sent, where every one is saved.
_WAITING = 2
#: The process must have begun within this time, seconds; it imports Rerun first.
_OPEN_S = 60.0
#: Longest wait for room; the process itself says after 10 s that its file is stuck.
_STUCK_S = 15.0
#: What closing may take besides the file.
_REST_S = 0.7
#: Time between two looks whether it is over, seconds.
_LOOK_S = 0.5
#: Frames over which the rate is taken.
_RATE_FRAMES = 10
#: A device clock past this (the year 2001) is a date.
_EPOCH_NS = 1_000_000_000 * 10**9


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """A frame that waits to be drawn, with what was true of it when it was shown."""

    result: FrameResult
    moment: Moment
    elapsed_ms: Mapping[str, float]
    rate_hz: float


@dataclass(frozen=True, slots=True)
class _Line:
    """A line of the log that waits to be sent."""

    moment: Moment
    level: int
    text: str


class IsolatedView:
    """Shows and saves frames as `nurbseg.app.view.rerun.RerunView` does, but by another process.

    A thread draws each frame and hands it over, another one listens. Where a file is saved, every frame is,
    and `show` waits if the process is behind; otherwise the oldest frame that waits is dropped.

    Parameters
    ----------
    process : ViewProcess
        Which has just begun; ended with this view.
    config : ViewConfig
        Where, and how fine.
    segmentation : SegmentationConfig
        Kept with the recording; names the metric that is shown.
    metadata : mapping of str to str
        What is known of the device; kept with the recording.
    name : str
        What the recording is called.
    logger : logging.Logger
        Its messages are shown too.

    Attributes
    ----------
    how_to_look : str
        What a person does to see it; empty where a window opens by itself.
    serving : bool
        Whether a web page is served, which ends with this view.
    connections : int
        How often a viewer was connected to; more than 1 where one was lost and came back.

    Raises
    ------
    ViewError
        If the file cannot be created, a port is taken, or the viewer cannot be started.
    """

    def __init__(
        self,
        process: ViewProcess,
        config: ViewConfig,
        segmentation: SegmentationConfig,
        metadata: Mapping[str, str],
        name: str,
        logger: logging.Logger,
    ) -> None:
        self.how_to_look, self.serving, self.connections = "", False, 0
        self._process = process
        self._config = config
        self._metric = segmentation.metric
        self._logger = logger
        self._slots = SharedSlots(process.memory)
        self._outbox: Outbox[_Shown | _Line] = Outbox(
            _WAITING if config.save else 1, lossless=config.save is not None
        )
        self._changed = threading.Condition()
        self._free = list(range(SLOTS))
        self._problem = ""
        self._over = self._closed = False
        self._dropped_there = 0
        self._known: Calibration | None = None
        self._shown_s: deque[float] = deque(maxlen=_RATE_FRAMES + 1)
        self._moment = Moment(0, None, False)
        self._since_epoch: bool | None = None
        self._file_limit_s = FILE_CLOSE_S
        try:
            self._open(segmentation, metadata, name)
        except BaseException:
            process.close()
            raise
        # Daemons: a program that never closes the view ends all the same, and then the file is closed.
        self._threads = [
            threading.Thread(target=target, name=f"view-{target.__name__.strip('_')}", daemon=True)
            for target in (self._send, self._listen)
        ]
        for thread in self._threads:
            thread.start()
        self._handler = _LogHandler(self)
        logger.addHandler(self._handler)

    @property
    def dropped(self) -> int:
        """Frames that were not shown live because the viewer was slow, frozen or absent."""
        return self._outbox.dropped + self._dropped_there

    def peak_memory_mb(self) -> float:
        """Return the largest resident size that the process has had, 10^6 bytes; 0 where it is not known."""
        return self._process.peak_memory_mb()

    def wait_connected(self, timeout_s: float) -> bool:
        """Wait until a viewer takes frames; return whether one does, within `timeout_s` seconds."""
        with self._changed:
            return self._changed.wait_for(lambda: self.connections > 0 or self._over, timeout_s) and (
                self.connections > 0
            )

    def show(self, result: FrameResult) -> None:
        """Show a frame and save it.

        Parameters
        ----------
        result : FrameResult
            The frame; a viewer that is behind gets the newest one only, the file gets every one.

        Raises
        ------
        ViewError
            If the file can no longer be written, or the process that shows and saves is gone.
        """
        if self._closed:
            raise ViewError("the view is closed")
        self._check()
        frame = result.frame
        if self._since_epoch is None:
            self._since_epoch = frame.timestamp_ns > _EPOCH_NS
        self._moment = Moment(frame.index, frame.timestamp_ns, self._since_epoch)
        self._shown_s.append(time.monotonic())
        shown = _Shown(result, self._moment, dict(result.elapsed_ms), self._rate_hz())
        try:
            self._outbox.put(shown, _STUCK_S)
        except TimeoutError:
            raise ViewError(f"{self._config.save}: took no frame for {_STUCK_S:g} s") from None
        self._check()

    def show_line(self, level: int, text: str) -> None:
        """Show a line of the log, of one of logging's levels; from any thread, never waits."""
        self._outbox.put_line(_Line(self._moment, level, text))

    def close(self, *, file_limit_s: float = FILE_CLOSE_S) -> None:
        """End within 2 s: the file is whole and can be read; a viewer's window stays.

        Parameters
        ----------
        file_limit_s : float
            Longest wait for a disk, seconds. A block that ends by itself waits longer for a slow one.

        Raises
        ------
        ViewError
            If the file is not whole.
        """
        if self._closed:
            return
        self._closed = True
        self._logger.removeHandler(self._handler)
        self._file_limit_s = file_limit_s
        self._outbox.close()
        with self._changed:
            ended = self._changed.wait_for(lambda: self._over, file_limit_s + _REST_S)
            if not ended and self._config.save is not None:
                self._fail(f"{self._config.save}: not written in time; its last frames are missing")
            self._over = True
            self._changed.notify_all()
        self._process.end()
        for thread in self._threads:
            thread.join()
        self._process.close()
        self._check()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close(file_limit_s=FILE_PATIENCE_S if exc_type is None else FILE_CLOSE_S)

    def _rate_hz(self) -> float:
        if len(self._shown_s) < 2:
            return 0.0
        return (len(self._shown_s) - 1) / max(self._shown_s[-1] - self._shown_s[0], 1e-6)

    def _check(self) -> None:
        if self._problem:
            raise ViewError(self._problem)

    def _fail(self, problem: str) -> None:
        """Take note of the first problem; nothing more is accepted."""
        self._problem = self._problem or problem
        self._outbox.close()

    def _open(self, segmentation: SegmentationConfig, metadata: Mapping[str, str], name: str) -> None:
        properties = _properties(self._config, segmentation, metadata)
        level = logging.getLogger("nurbseg").getEffectiveLevel()
        deadline_s = time.monotonic() + _OPEN_S
        try:
            self._process.words.send(("open", self._config, segmentation, properties, name, level))
            while self._process.words.poll(max(0.0, deadline_s - time.monotonic())):
                word, *rest = self._process.words.recv()
                if word == "opened":
                    self.how_to_look, self.serving = rest
                    return
                if word == "refused":
                    raise ViewError(rest[0])
                self._hear(word, rest)
        except (EOFError, OSError):
            raise ViewError(f"the process that shows and saves ended {self._process.end()}") from None
        raise ViewError(f"the process that shows and saves has not begun within {_OPEN_S:g} s")

    def _send(self) -> None:
        """Draw and hand over what is shown, then tell the process to end."""
        try:
            while not self._outbox.finished:
                for item in self._outbox.take(_LOOK_S):
                    if self._problem:
                        continue
                    if isinstance(item, _Line):
                        self._process.words.send(("line", item.moment, item.level, item.text))
                    else:
                        self._send_frame(item)
            self._process.words.send(("close", self._file_limit_s))
        except OSError:
            return  # it has ended, which the other thread tells

    def _send_frame(self, item: _Shown) -> None:
        parts: list[pickle.PickleBuffer] = []
        try:
            frame = drawn(
                item.result,
                self._config,
                self._metric,
                moment=item.moment,
                elapsed_ms=item.elapsed_ms,
                rate_hz=item.rate_hz,
                known=self._known,
            )
            # Arrays go through shared memory, what is left is small.
            body = pickle.dumps(frame, 5, buffer_callback=parts.append)
        except Exception as err:
            what = f"{self._config.save}: " if self._config.save else ""
            self._fail(f"{what}a frame cannot be shown ({type(err).__name__}): {err}")
            return
        self._known = item.result.frame.calibration
        raw = [part.raw() for part in parts]
        sizes = [part.nbytes for part in raw]
        slot = self._free_slot(sum(sizes))
        if slot is not None:
            self._slots.write(slot, raw)
            self._process.words.send(("frame", slot, self._slots.slot_bytes, sizes, body))

    def _free_slot(self, size: int) -> int | None:
        """Wait for a slot that has room; None if it is over, or there is no memory."""
        fits = size <= self._slots.slot_bytes
        with self._changed:
            # The first frame, or a larger one: all slots change their size together.
            self._changed.wait_for(lambda: self._over or len(self._free) >= (1 if fits else SLOTS))
            if self._over:
                return None
            if not fits:
                try:
                    self._slots.make_room(size)
                except OSError as err:
                    self._fail(f"no memory to hand frames over: {err.strerror}")
                    return None
            return self._free.pop()

    def _listen(self) -> None:
        try:
            while True:
                word, *rest = self._process.words.recv()
                self._hear(word, rest)
        except (EOFError, OSError):
            if not self._over:
                self._fail(f"the process that shows and saves ended {self._process.end()}")
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def _hear(self, word: str, rest: list[Any]) -> None:
        if word == "log":
            name, level, text = rest
            logging.getLogger(name).log(level, "%s", text)
            return
        if word == "failed":
            self._fail(rest[0])
        with self._changed:
            if word == "free":
                self._free.append(rest[0])
            elif word == "status":
                self._dropped_there, self.connections = rest
            elif word == "closed":
                self._over = True
            self._changed.notify_all()


def _properties(
    config: ViewConfig, segmentation: SegmentationConfig, metadata: Mapping[str, str]
) -> dict[str, dict[str, str]]:
    """Return what is kept with a recording, by subject, as text."""
    settings = {each.name: getattr(segmentation, each.name) for each in fields(segmentation)}
    properties: dict[str, Mapping[str, Any]] = {
        "segmentation": settings,
        "view": {key: value for key, value in asdict(config).items() if value is not None},
        "versions": versions(),
    }
    if metadata:
        properties["device"] = metadata
    # As text: Rerun holds one name to one type, and a device may call anything anything.
    return {name: {key: str(value) for key, value in each.items()} for name, each in properties.items()}


class _LogHandler(logging.Handler):
    """Shows the program's log."""

    def __init__(self, view: IsolatedView) -> None:
        super().__init__()
        self._view = view

    def emit(self, record: logging.LogRecord) -> None:
        self._view.show_line(record.levelno, record.getMessage())


__all__ = ["IsolatedView"]
