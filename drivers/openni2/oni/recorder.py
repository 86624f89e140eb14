"""Records a camera with OpenNI2's own recorder, and works around its faults."""

import ctypes
import logging
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from nurbseg.drivers.closing import closed_on_error
from nurbseg.drivers.errors import DriverError
from nurbseg.drivers.files import create_private
from nurbseg.drivers.openni2.capi import Sensor, StreamProperty
from nurbseg.drivers.openni2.oni.file import correct_header, finish, has_begun, read_structure
from nurbseg.drivers.openni2.oni.player import PlayedImage, PlayerProcess
from nurbseg.drivers.openni2.opened import OpenedDevice
from nurbseg.drivers.openni2.stream import Image

logger = logging.getLogger(__name__)

#: Time within which the recorder's own thread must have started, seconds.
_START_LIMIT_S = 5.0
#: The player starts within this time, seconds.
_PLAY_LIMIT_S = 15.0
#: The first image seen here is among this many at the file's beginning.
_FIRST_IMAGES = 12


class OniRecorder:
    """OpenNI2's recorder at work on a device's streams; it writes each image that the driver delivers.

    The recorder's own thread keeps a processor core busy for as long as it lives. Depth is packed without
    loss, if it is below the stream's largest value and an image holds at most 32767 different depths, which
    these cameras keep to; color is kept as it is, or packed as JPEG where `lossy`.

    The streams are not running: the recorder must be there before the first image, or else the two streams
    may begin with different moments, which the file could not record. The file must not exist, and only this
    user may read it. Raises DriverError if it cannot be made, or the recorder does not start.
    """

    def __init__(self, device: OpenedDevice, path: Path, *, lossy: bool = False) -> None:
        self.path = path
        self._seen: dict[Sensor, Image] = {}
        self._device = device
        self._handle = ctypes.c_void_p()
        library = device.library
        largest = device.streams[0].find(StreamProperty.MAX_VALUE, ctypes.c_int)
        #: Depth of this value or more is stored wrong; no limit where the device reports none.
        self._depth_limit: int = largest or 1 << 16
        self._beyond_limit = 0
        try:
            # OpenNI2 gives no reason where it cannot make a file; this does.
            create_private(path).close()
        except OSError as err:
            raise DriverError(f"{path}: cannot be recorded to ({err.strerror})") from err
        library.check(
            library.native.oniCreateRecorder(os.fsencode(path), ctypes.byref(self._handle)),
            f"recording to {path}",
        )
        with closed_on_error(self._destroy):
            for stream in device.streams:
                library.check(
                    library.native.oniRecorderAttachStream(self._handle, stream.handle, int(lossy)),
                    f"recording the {stream.sensor.name.lower()} stream to {path}",
                )
            library.check(library.native.oniRecorderStart(self._handle), f"recording to {path}")
            self._wait_until_begun()

    def _wait_until_begun(self) -> None:
        deadline = time.monotonic() + _START_LIMIT_S
        while not has_begun(self.path, len(self._device.streams)):
            if time.monotonic() > deadline:
                raise DriverError(f"{self.path}: OpenNI2's recorder does not start")
            time.sleep(0.002)
        correct_header(self.path)

    def _destroy(self) -> None:
        native = self._device.library.native
        native.oniRecorderStop(self._handle)
        # Waits until everything that was delivered is written.
        native.oniRecorderDestroy(ctypes.byref(self._handle))

    def see(self, sensor: Sensor, image: Image) -> None:
        """Register an image that the driver delivers, which the recorder writes too."""
        self._seen.setdefault(sensor, image)
        if sensor == Sensor.DEPTH:
            self._beyond_limit += int(image.pixels.max()) >= self._depth_limit

    def close(self, note: dict[str, Any]) -> None:
        """Finish the file; must come before the streams are destroyed.

        The note goes to the file's end, where OpenNI2 does not read: what its format has no place for. Raises
        RecordingFormatError if the file could not be finished: the disk was full.
        """
        self._destroy()
        if self._beyond_limit:
            logger.warning(
                "%s: %d depth images held depth of %d or more, which .oni stores incorrectly",
                self.path,
                self._beyond_limit,
                self._depth_limit,
            )
        finish(self.path, note)
        finish(self.path, note | {"color_delay_us": self._color_delay_us()})

    def _color_delay_us(self) -> int:
        """Return how much later the file's first color image was taken than its first depth image.

        The file forgets it: the times of each stream begin at 0 there. The device's times are known for
        the images that were seen here; which ones of the file these are is found by comparing pixels.
        """
        if len(self._seen) < 2:
            return 0
        differences: dict[Sensor, list[float]] = {Sensor.DEPTH: [], Sensor.COLOR: []}
        with PlayerProcess(self.path) as player:
            while len(differences[Sensor.DEPTH]) < _FIRST_IMAGES:
                answer = player.receive(_PLAY_LIMIT_S)
                if answer is None or answer.value is None:
                    break
                if isinstance(image := answer.value, PlayedImage) and image.sensor in self._seen:
                    difference = image.pixels.astype(np.int32) - self._seen[image.sensor].pixels
                    differences[image.sensor].append(float(np.abs(difference).mean()))
        structure = read_structure(self.path)
        begun_us: dict[Sensor, int] = {}
        for kind, stream in ((Sensor.DEPTH, structure.depth), (Sensor.COLOR, structure.color)):
            # Lossy color is not quite the same, so the most similar image is taken.
            position = int(np.argmin(differences[kind])) if differences[kind] else 0
            begun_us[kind] = self._seen[kind].timestamp_us - stream.frames[position].timestamp_us
        return begun_us[Sensor.COLOR] - begun_us[Sensor.DEPTH]
