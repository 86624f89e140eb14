"""Further cameras that are recorded beside the first: their threads and their time."""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from nurbseg.common.errors import DriverError, FrameFormatError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.source import FrameSource

_log = logging.getLogger(__name__)

#: Longest wait of one read, and pause after one that failed, seconds.
_READ_TIMEOUT_S, _ERROR_PAUSE_S = 0.5, 0.01
#: Longest wait for a thread at the end, seconds.
_STOP_TIMEOUT_S = 5.0
#: A clock that is off by more than this was reset, nanoseconds.
_RESET_NS = 200_000_000
#: Weight of a frame in the average by which the drift of clocks is followed: half a minute at 30 Hz.
_FOLLOWED = 1 / 1000


class FirstClock:
    """Brings the times of several cameras, each with a clock of its own, to the clock of the first.

    Frames that arrive at the same time get the same time, to some milliseconds. From frame to frame each
    camera's own clock counts; its drift is followed slowly, and a reset at once.
    """

    def __init__(self) -> None:
        #: By camera: its clock less this computer's, nanoseconds.
        self._ahead_ns: dict[int, int] = {}

    def first_came(self, frame: RGBDFrame) -> None:
        """Take note of a frame of the first camera."""
        self._compare(0, frame)

    def timed(self, camera: int, frame: RGBDFrame) -> RGBDFrame | None:
        """Return a frame of a further camera by the first one's clock; None until that has a frame."""
        if 0 not in self._ahead_ns:
            return None
        self._compare(camera, frame)
        by_first_ns = frame.timestamp_ns + self._ahead_ns[0] - self._ahead_ns[camera]
        return replace(frame, timestamp_ns=max(0, by_first_ns))

    def _compare(self, camera: int, frame: RGBDFrame) -> None:
        arrived_s = time.monotonic() if frame.arrived_s is None else frame.arrived_s
        ahead_ns = frame.timestamp_ns - round(1e9 * arrived_s)
        off_ns = ahead_ns - self._ahead_ns.setdefault(camera, ahead_ns)
        self._ahead_ns[camera] += off_ns if abs(off_ns) > _RESET_NS else round(_FOLLOWED * off_ns)


class BesideThread:
    """Reads every frame of a further camera and puts it.

    A camera that fails is named, and left out from then on; the run goes on.

    Parameters
    ----------
    camera : FrameSource
        It is borrowed.
    number : int
        Its number, from 1 on.
    put : callable
        Takes the number and a frame.
    """

    def __init__(self, camera: FrameSource, number: int, put: Callable[[int, RGBDFrame], None]) -> None:
        self._camera, self._number, self._put = camera, number, put
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"camera {number + 1}", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def stop(self) -> None:
        """Stop reading; wait a few seconds at most."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(_STOP_TIMEOUT_S)

    def _run(self) -> None:
        with self._camera.reader(every=True) as reader:
            while not self._stop.is_set():
                try:
                    self._put(self._number, reader.read(_READ_TIMEOUT_S))
                except (FrameTimeoutError, FrameFormatError):
                    self._stop.wait(_ERROR_PAUSE_S)
                except DriverError as err:
                    _log.error("camera %d: %s; it is not recorded any more", self._number + 1, err)
                    return
