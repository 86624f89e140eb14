"""A source that plays a script of frames and errors, and small frames for it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from nurbseg.common.errors import EndOfRecordingError, FrameTimeoutError
from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame
from nurbseg.drivers.datasets.sequence import SequenceSource
from nurbseg.drivers.mcap.writer import RecordingWriter
from nurbseg.drivers.source import FrameSource

CALIBRATION = Calibration.registered(Intrinsics(width=8, height=6, fx=10.0, fy=10.0, cx=3.5, cy=2.5))


def small_frame(index: int, timestamp_s: float | None = None) -> RGBDFrame:
    """Return a frame of 8 x 6 pixels whose depth tells its number."""
    return RGBDFrame(
        index=index,
        timestamp_ns=round((index / 30 if timestamp_s is None else timestamp_s) * 1e9),
        depth_mm=np.full((6, 8), 1000 + index, dtype=np.uint16),
        color=np.zeros((6, 8, 3), dtype=np.uint8),
        calibration=CALIBRATION,
    )


class NumberedSource(SequenceSource):
    """A recording of small frames that goes to any of them."""

    def __init__(self, frames: int) -> None:
        super().__init__(Path(__file__), frames, "numbered")
        self.calibration = CALIBRATION

    def _load(self, index: int) -> RGBDFrame:
        return small_frame(index)


def write_numbered(path: Path, frames: int) -> Path:
    """Record small frames to a file, and return it."""
    with RecordingWriter(path, CALIBRATION, color_format="raw") as writer:
        for index in range(frames):
            writer.write(small_frame(index))
    return path


class ScriptedSource(FrameSource):
    """Gives what its script says, one entry a read; an exception is raised, and after the end EOF.

    With `released`, a read waits until the event is set, as a camera waits for light.
    """

    def __init__(
        self,
        script: Sequence[RGBDFrame | BaseException],
        *,
        live: bool = False,
        released: threading.Event | None = None,
    ) -> None:
        super().__init__()
        self.calibration = CALIBRATION
        self.live = live
        self.reads = 0
        self.readers: set[str] = set()
        self._script = list(script)
        self._released = released

    def _read(self, timeout_s: float) -> RGBDFrame:
        self.readers.add(threading.current_thread().name)
        if self._released is not None and not self._released.wait(timeout_s):
            raise FrameTimeoutError("nothing yet")
        self.reads += 1
        if not self._script:
            raise EndOfRecordingError("the script is over")
        entry = self._script.pop(0)
        if isinstance(entry, BaseException):
            raise entry
        return entry

    def _close(self) -> None:
        pass
