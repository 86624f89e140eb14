"""Progress of a run in the log: one line every few seconds."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping

from nurbseg.app.live.capture import CaptureThread
from nurbseg.drivers.frame import RGBDFrame

_log = logging.getLogger(__name__)

#: Time between two lines, seconds.
_INTERVAL_S = 5.0


class Progress:
    """Logs the progress of a run.

    Parameters
    ----------
    capture : CaptureThread
        Whose counts are logged.
    clock : callable
        Monotonic seconds.
    """

    def __init__(self, capture: CaptureThread, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._capture = capture
        self._clock = clock
        self._logged_s = clock()
        self._frames = self._withheld = 0
        self._is_first = True

    def segmented(
        self, frame: RGBDFrame, leaves: int, elapsed_ms: Mapping[str, float], *, late: int = 0
    ) -> None:
        """Say something of a frame, if it is time to, or the first; `late` were too old to be shown."""
        self._frames += 1
        name = f" ({frame.name})" if frame.name else ""
        took_ms = sum(elapsed_ms.get(stage, 0.0) for stage in ("register", "segment"))
        line = f"frame {frame.index}{name}: {leaves} segments in {took_ms:.0f} ms"
        _log.debug(line)
        elapsed_s = self._clock() - self._logged_s
        if self._is_first:
            _log.info(line)
        elif elapsed_s >= _INTERVAL_S:
            dropped = self._capture.frames.dropped
            drops = f", {dropped} overwritten by newer ones" if dropped else ""
            drops += f", {late} too late" if late else ""
            drops += self._recorded()
            _log.info(
                "%s; %.1f frames/s, %d read%s", line, self._frames / elapsed_s, self._capture.read, drops
            )
        else:
            return
        self._withheld = self._capture.withheld
        self._is_first, self._frames, self._logged_s = False, 0, self._clock()

    def recorded(self) -> None:
        """Say how the recording goes, if it is time to."""
        if self._clock() - self._logged_s >= _INTERVAL_S:
            _log.info("%d read%s", self._capture.read, self._recorded())
            self._logged_s = self._clock()

    def _recorded(self) -> str:
        recording = self._capture.recording
        if recording is None:
            return ""
        return f", {recording.frames} recorded" + (f", {recording.lost} lost" if recording.lost else "")

    def waiting(self) -> None:
        """Say that no frame comes, or that all are kept for the recording, if that lasts."""
        if self._clock() - self._logged_s >= _INTERVAL_S:
            if withheld := self._capture.withheld - self._withheld:
                _log.info("writing is slow: %d frames recorded only%s", withheld, self._recorded())
            else:
                _log.info("waiting for a frame")
            self._withheld += withheld
            self._frames, self._logged_s = 0, self._clock()
