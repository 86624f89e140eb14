"""Opens a camera again that was lost, when it is back."""

from __future__ import annotations

from collections.abc import Callable

from nurbseg.drivers.errors import DeviceNotFoundError, DriverError
from nurbseg.drivers.openni2.isolated.source import IsolatedCamera
from nurbseg.drivers.process.child import ChildProcess


class Reopening:
    """Asks each time whether the camera is back, of one process that looks for it meanwhile.

    One such process is kept ready: to start Python takes longer than all else that is done when a camera is
    plugged in again.
    """

    def __init__(
        self,
        begin: Callable[[], ChildProcess],
        open_patiently: Callable[[ChildProcess], IsolatedCamera],
    ) -> None:
        self._begin = begin
        self._open_patiently = open_patiently
        self._ready: ChildProcess | None = begin()
        self._waiting: IsolatedCamera | None = None

    def __call__(self) -> IsolatedCamera:
        """Return the camera, open, for the caller to close; a DriverError says why it is not back."""
        if self._waiting is None:
            process, self._ready = self._ready or self._begin(), None
            self._waiting = self._open_patiently(process)
        try:
            is_open = self._waiting.is_open()
        except DriverError:
            self.close()
            raise
        if not is_open:
            raise DeviceNotFoundError("the camera is disconnected")
        camera, self._waiting = self._waiting, None
        self._ready = self._begin()
        return camera

    def close(self) -> None:
        """Look no longer; safe to repeat."""
        waiting, self._waiting = self._waiting, None
        ready, self._ready = self._ready, None
        for each in (waiting, ready):
            if each is not None:
                each.close()
