"""Records a camera with OpenNI2's own recorder, around its traps."""

from __future__ import annotations

import ctypes
import logging
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.openni2.capi import StreamProperty
from nurbseg.drivers.openni2.oni_file import finish, has_begun
from nurbseg.drivers.openni2.opened import OpenedDevice

logger = logging.getLogger(__name__)

#: The recorder starts on its own thread; longer than this, and it never will, seconds.
_START_LIMIT_S = 5.0


@dataclass(slots=True)
class FirstStamps:
    """When each stream's first image after the start was taken, device microseconds."""

    depth_us: int | None = None
    color_us: int | None = None

    @property
    def color_delay_us(self) -> int:
        """How much later than the first depth image the first color image was taken.

        The file forgets it: the times of each stream begin at 0 there.
        """
        if self.depth_us is None or self.color_us is None:
            return 0
        return self.color_us - self.depth_us


class OniRecorder:
    """OpenNI2's recorder at work on a device's streams; it writes each image that the driver delivers.

    The recorder's own thread keeps a processor core busy for as long as it lives. Depth is packed
    without loss, if it is below the stream's largest value and an image holds at most 32767 different
    depths, which these cameras keep to; color is kept as it is, or packed as JPEG.

    Parameters
    ----------
    device : OpenedDevice
        Its streams are not running: the recorder must be there before the first image, or else
        the two streams may begin with different moments, which the file could not tell.
    path : Path
        The file; written over.
    lossy : bool
        Whether color is packed as JPEG.

    Raises
    ------
    DriverError
        If the file cannot be made, or the recorder does not start.
    """

    def __init__(self, device: OpenedDevice, path: Path, *, lossy: bool = False) -> None:
        self.path = path
        self.first = FirstStamps()
        self._device = device
        self._handle = ctypes.c_void_p()
        library = device.library
        largest = device.streams[0].find(StreamProperty.MAX_VALUE, ctypes.c_int)
        #: Depth from here on comes out wrong; no limit where the device tells none.
        self.depth_limit: int = largest or 1 << 16
        self.beyond_limit = 0
        try:
            # OpenNI2 gives no reason where it cannot make a file; this does.
            path.open("wb").close()
        except OSError as err:
            raise DriverError(f"{path}: cannot be recorded to ({err.strerror})") from err
        library.check(
            library.native.oniCreateRecorder(os.fsencode(path), ctypes.byref(self._handle)),
            f"recording to {path}",
        )
        try:
            for stream in device.streams:
                library.check(
                    library.native.oniRecorderAttachStream(self._handle, stream.handle, int(lossy)),
                    f"recording the {stream.sensor.name.lower()} stream to {path}",
                )
            library.check(library.native.oniRecorderStart(self._handle), f"recording to {path}")
            self._wait_until_begun()
        except BaseException:
            self._destroy()
            raise

    def _wait_until_begun(self) -> None:
        deadline = time.monotonic() + _START_LIMIT_S
        while not has_begun(self.path, len(self._device.streams)):
            if time.monotonic() > deadline:
                raise DriverError(f"{self.path}: OpenNI2's recorder does not start")
            time.sleep(0.002)

    def _destroy(self) -> None:
        native = self._device.library.native
        native.oniRecorderStop(self._handle)
        # Waits until everything that was delivered is written.
        native.oniRecorderDestroy(ctypes.byref(self._handle))

    def close(self, note: dict[str, Any]) -> None:
        """Finish the file; must come before the streams are destroyed.

        Parameters
        ----------
        note : dict
            Goes to the file's end, where OpenNI2 does not read: what its format has no place for.

        Raises
        ------
        RecordingFormatError
            If the file could not be finished: the disk was full.
        """
        self._destroy()
        if self.beyond_limit:
            logger.warning(
                "%s: %d depth images held depth of %d or more, which .oni keeps wrong",
                self.path,
                self.beyond_limit,
                self.depth_limit,
            )
        finish(self.path, note | {"color_delay_us": self.first.color_delay_us})
