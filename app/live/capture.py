"""From the source to the worker: a thread that reads frames, and the slot in which it leaves them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Generic, Self, TypeVar

from nurbseg.drivers.errors import EndOfRecordingError, FrameFormatError, FrameTimeoutError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.source import FrameSource

if TYPE_CHECKING:
    from nurbseg.app.recording.recorder import Recording

_log = logging.getLogger(__name__)

#: Longest wait of one read, seconds; stopping takes at most this long.
_READ_TIMEOUT_S = 0.5
#: Longest wait for the read that is under way when the run ends: a file on a dead disk never answers.
_STOP_TIMEOUT_S = 5.0
#: Damaged frames that are told one by one; the others are counted.
_DAMAGED_NAMED_MAX = 20

Item = TypeVar("Item")


class LatestSlot(Generic[Item]):
    """A place for one item between one producer and one consumer.

    Parameters
    ----------
    lossless : bool
        Whether `put` waits until the item before was taken, instead of overwriting it.

    Attributes
    ----------
    overwritten : int
        Items that were replaced by a newer one before they were taken.
    """

    def __init__(self, *, lossless: bool = False) -> None:
        self.overwritten = 0
        self._lossless = lossless
        self._changed = threading.Condition()
        self._items: list[Item] = []
        self._finished = False
        self._error: BaseException | None = None

    def put(self, item: Item) -> bool:
        """Leave an item; return False where the slot is closed, and nobody will take it."""
        with self._changed:
            if self._lossless:
                # No time limit of its own: the consumer takes the item, or closes the slot.
                while self._items and not self._finished:
                    self._changed.wait(_READ_TIMEOUT_S)
            if self._finished:
                return False
            self.overwritten += len(self._items)
            self._items = [item]
            self._changed.notify_all()
            return True

    def take(self, timeout_s: float) -> Item | None:
        """Take the item, each one once; None after the last one.

        Parameters
        ----------
        timeout_s : float
            Longest wait, seconds.

        Raises
        ------
        TimeoutError
            If no item came in time.
        Exception
            The error with which the producer finished, after its last item.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._items or self._finished, timeout_s):
                raise TimeoutError(f"no frame within {timeout_s} s")
            if self._items:
                self._changed.notify_all()
                return self._items.pop()
            if self._error is not None:
                raise self._error
            return None

    def finish(self, error: BaseException | None = None) -> None:
        """Say that no item follows, because of an error or because that was all; for the producer."""
        with self._changed:
            if not self._finished:
                self._finished, self._error = True, error
                self._changed.notify_all()

    def close(self) -> None:
        """Say that no item will be taken any more; for the consumer."""
        with self._changed:
            self._items, self._finished, self._error = [], True, None
            self._changed.notify_all()


@dataclass(frozen=True, slots=True, eq=False)
class Captured:
    """A frame and when it came.

    Parameters
    ----------
    frame : RGBDFrame
        The frame.
    arrived_s : float
        When the source handed it out, `time.monotonic` seconds.
    """

    frame: RGBDFrame
    arrived_s: float


class CaptureThread:
    """Reads a source on a thread of its own and leaves the frames in a slot.

    It borrows the source: stop the thread (leave the ``with`` block) before closing that. A damaged
    frame is named in the log, counted, and passed over; every other error of the source comes out of
    the slot's `take`, after the frames read before it.

    Parameters
    ----------
    source : FrameSource
        Read by this thread alone from now on.
    lossless : bool
        Whether the source waits for the consumer instead of running on.
    recording : Recording, optional
        Gets every frame first; while it is behind, frames are not left in the slot.

    Attributes
    ----------
    frames : LatestSlot of Captured
        Where the frames are left.
    read : int
        Frames read.
    withheld : int
        Frames that were not left in the slot, because the recording was behind.
    damaged : int
        Frames that could not be read.
    damaged_frames : list of str
        What was wrong with the first of them.
    """

    def __init__(
        self, source: FrameSource, *, lossless: bool = False, recording: Recording | None = None
    ) -> None:
        self.recording = recording
        self.withheld = 0
        self.frames: LatestSlot[Captured] = LatestSlot(lossless=lossless)
        self.read = 0
        self.damaged = 0
        self.damaged_frames: list[str] = []
        self._source = source
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="capture")

    def __enter__(self) -> Self:
        try:
            self._thread.start()
        except BaseException:
            # Ctrl-C may come between the start and its confirmation.
            self.stop()
            raise
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def losses(self) -> Mapping[str, int]:
        """What the source lost before it could be read, counted by reason."""
        return self._source.losses

    def stop(self) -> None:
        """Stop reading, and wait for the read that is under way, a few seconds at most."""
        self._stop.set()
        self.frames.close()
        if self._thread.ident is not None:
            self._thread.join(_STOP_TIMEOUT_S)
            if self._thread.is_alive():
                _log.error("the source did not answer within %g s and is left behind", _STOP_TIMEOUT_S)

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    frame = self._source.read(_READ_TIMEOUT_S)
                except FrameTimeoutError:
                    continue
                except FrameFormatError as err:
                    self._pass_over(err)
                    continue
                self.read += 1
                if self.recording is not None:
                    self.recording.put(frame)
                    if self.recording.behind:
                        self.withheld += 1
                        continue
                if not self.frames.put(Captured(frame, time.monotonic())):
                    return
            self.frames.finish()
        except EndOfRecordingError:
            self.frames.finish()
        except BaseException as err:
            # A thread that dies is never silent: the worker raises this.
            self.frames.finish(err)
        finally:
            if self.recording is not None:
                self.recording.finish()

    def _pass_over(self, err: FrameFormatError) -> None:
        self.damaged += 1
        if self.damaged <= _DAMAGED_NAMED_MAX:
            self.damaged_frames.append(str(err))
            _log.warning("skipped a damaged frame: %s", err)
        elif self.damaged == _DAMAGED_NAMED_MAX + 1:
            _log.warning(
                "skipped more than %d damaged frames; from here on they are only counted", _DAMAGED_NAMED_MAX
            )
