"""Opens a camera again that was lost, when it is back."""

from __future__ import annotations

from collections.abc import Callable

from nurbseg.drivers.errors import DeviceNotFoundError, DriverError
from nurbseg.drivers.openni2.isolated.source import IsolatedCamera


class Reopening:
    """Asks each time whether the camera is back, of one process that looks for it meanwhile.

    Parameters
    ----------
    open_patiently : callable
        Starts such a process: opens an `IsolatedCamera` with patience.
    """

    def __init__(self, open_patiently: Callable[[], IsolatedCamera]) -> None:
        self._open_patiently = open_patiently
        self._waiting: IsolatedCamera | None = None

    def __call__(self) -> IsolatedCamera:
        """Return the camera, open; the caller closes it.

        Raises
        ------
        DriverError
            If it is not back, or cannot be opened.
        """
        if self._waiting is None:
            self._waiting = self._open_patiently()
        try:
            is_open = self._waiting.is_open()
        except DriverError:
            self.close()
            raise
        if not is_open:
            raise DeviceNotFoundError("the camera is away")
        camera, self._waiting = self._waiting, None
        return camera

    def close(self) -> None:
        """Look no longer; safe to repeat."""
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            waiting.close()
