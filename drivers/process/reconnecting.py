"""A camera that is opened again when it is back after it was unplugged, so that frames continue."""

import dataclasses
import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping

from nurbseg.common.errors import DeviceLostError, DriverError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.opening import CAMERAS
from nurbseg.drivers.process.messages import Lost, Opened
from nurbseg.drivers.source import FrameSource

logger = logging.getLogger(__name__)

#: Longest pause between two attempts with a camera that delivers nothing, seconds; and how often it doubles.
_LONGEST_PAUSE_S, _DOUBLED_MAX = 30.0, 16


def same_camera(uri: str, metadata: Mapping[str, str]) -> str:
    """Return the URI of a camera that was opened as `uri`, by which no other one is found."""
    scheme = uri.partition(":")[0]
    same = metadata.get("serial", "")
    if not same and scheme == "openni2":
        same = f"port:{metadata['usb_port']}"
    return f"{scheme}:{same}" if scheme in CAMERAS else uri


class Reconnecting(FrameSource):
    """A live source that continues after its camera was unplugged and plugged in again.

    While the camera is disconnected, `read` raises FrameTimeoutError when its time limit is over, as for a
    slow camera. When it is back, indices continue, and so do timestamps, advanced by the time that has
    passed: a camera's clock restarts when it is plugged in.

    The open `source` is owned; a `Lost` in its place says which camera is looked for. `reopen` returns an
    open source of the same camera. After a DriverError it is called again, every `interval_s` seconds at
    most. Where a camera is lost again without a frame, the interval doubles each time, up to 30 s.

    Attributes
    ----------
    reconnections : int
        How often it was reopened.
    """

    live = True

    def __init__(
        self,
        source: FrameSource | Lost,
        reopen: Callable[[], FrameSource],
        *,
        interval_s: float = 0.5,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        super().__init__()
        self._reopen, self._interval_s = reopen, interval_s
        self._clock, self._sleep = clock, sleep
        #: Of the camera; None while it is disconnected.
        self._source = None if isinstance(source, Lost) else source
        self._losses: Counter[str] = Counter()
        self._index = self._last_ns = self._fruitless = 0
        self._last_s: float | None = None
        known: FrameSource | Opened
        if isinstance(source, Lost):
            known = source.opened
            self._losses.update(source.status.losses)
            self._index, self._last_ns, self._last_s = source.index + 1, source.timestamp_ns, source.arrived_s
            self._fruitless = source.fruitless
        else:
            known = source
        self.calibration, self.metadata = known.calibration, dict(known.metadata)
        self.reconnections = self._losses.pop("reconnections", 0)
        self._ahead_ns: int | None = None if self._source is None else 0
        self._next_try_s = clock() + self._pause_s()

    @property
    def connected(self) -> bool:
        """Whether the camera is there."""
        return self._source is not None

    @property
    def losses(self) -> Mapping[str, int]:
        """Losses of the camera, before and after disconnections, and the number of these."""
        lost = Counter(self._losses)
        if self._source is not None:
            lost.update(self._source.losses)
        return {**lost, "reconnections": self.reconnections}

    def _read(self, timeout_s: float) -> RGBDFrame:
        deadline = self._clock() + timeout_s
        while True:
            source = self._connected_source(deadline, timeout_s)
            try:
                frame = source.read(max(deadline - self._clock(), 0.0))
            except DeviceLostError as err:
                logger.warning("%s; waiting for it to come back", err)
                try:
                    self._close()
                except DriverError as second:  # of its recording, which ends here
                    logger.error("%s", second)
                self._next_try_s = self._clock() + self._pause_s()
                self._fruitless += 1
                self._ahead_ns = None
            else:
                return self._continued(frame)

    def _pause_s(self) -> float:
        """Return the time before the next try: a camera that comes back at once is found at once."""
        pause_s = self._interval_s * 2 ** min(self._fruitless, _DOUBLED_MAX) if self._fruitless else 0.0
        return min(pause_s, max(self._interval_s, _LONGEST_PAUSE_S))

    def _connected_source(self, deadline: float, timeout_s: float) -> FrameSource:
        """Return the source of the camera, which may have to come back first."""
        while self._source is None:
            if self._clock() >= self._next_try_s:
                try:
                    self._source = self._reopen()
                except DriverError as err:
                    logger.debug("still disconnected: %s", err)
                    self._next_try_s = self._clock() + self._interval_s
                else:
                    self._take_over(self._source)
                    break
            now = self._clock()
            if now >= deadline:
                raise FrameTimeoutError(f"the camera is disconnected: no frame within {timeout_s:g} s")
            self._sleep(max(0.0, min(self._next_try_s, deadline) - now))
        return self._source

    def _take_over(self, source: FrameSource) -> None:
        before, self.calibration = self.calibration, source.calibration
        # In place, since the player holds this dictionary.
        self.metadata.update(source.metadata)
        if before.is_registered != source.calibration.is_registered:
            logger.warning(
                "%s now %s depth to color, unlike before; recordings keep the earlier calibration",
                self.metadata.get("device", "the camera"),
                "registers" if source.calibration.is_registered else "does not register",
            )

    def _continued(self, frame: RGBDFrame) -> RGBDFrame:
        now_s = self._clock()
        if self._ahead_ns is None:
            self.reconnections += 1
            logger.warning("%s is back; frames resume", self.metadata.get("device", "the camera"))
            away_s = 0.0 if self._last_s is None else now_s - self._last_s
            self._ahead_ns = self._last_ns + round(away_s * 1e9) - frame.timestamp_ns
        if self._ahead_ns or frame.index != self._index:
            frame = dataclasses.replace(
                frame, index=self._index, timestamp_ns=frame.timestamp_ns + self._ahead_ns
            )
        self._fruitless = 0
        self._index += 1
        self._last_ns, self._last_s = frame.timestamp_ns, now_s
        return frame

    def _close(self) -> None:
        source, self._source = self._source, None
        if source is not None:
            self._losses.update(source.losses)
            source.close()
