"""A depth camera through OpenNI2, as a source of frames."""

import time

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import FrameFormatError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.live.device_clock import DeviceClock
from nurbseg.drivers.live.paired_camera import Image, PairedCamera
from nurbseg.drivers.openni2.capi import DeviceState, Sensor
from nurbseg.drivers.openni2.configuration import calibrate, configure, set_modes
from nurbseg.drivers.openni2.opened import describe, open_camera
from nurbseg.drivers.openni2.stream import frame_of, wait_for_any
from nurbseg.drivers.options import DeviceOptions

#: Pause where the library names an image that is not there, seconds.
_EMPTY_S = 1e-3
#: Pairs dropped after the settings were applied: they were still taken with the previous ones.
_SETTLING_PAIRS = 2


class DeviceSource(PairedCamera):
    """Frames of a camera.

    `wanted` is interpreted by `nurbseg.drivers.openni2.opened.choose`. Where `pairing_limit_s` is longer
    than half a period of the faster stream, that is the limit.

    Raises BackendMissingError if the library is not installed, DeviceNotFoundError if there is no such camera
    or it cannot be opened, CalibrationError if the options name a calibration file that is damaged, and
    DriverError if the camera has no such streams or modes.
    """

    def __init__(
        self,
        wanted: str = "any",
        options: DeviceOptions | None = None,
        pairing_limit_s: float = 0.02,
    ) -> None:
        super().__init__(options)
        self._settling = _SETTLING_PAIRS
        self._device, listing = open_camera(wanted, self._options.serial)
        with closed_on_error(self.close):
            depth = self._device.add_stream(Sensor.DEPTH)
            color = self._device.add_stream(Sensor.COLOR)
            set_modes(depth, color, self._options)
            depth.start()
            color.start()
            self.metadata.update(describe(listing, self._device))
            self._clock = DeviceClock(self.metadata["device"])
            registered, self._flips, states = configure(self._device, self._options, self.metadata["device"])
            self.metadata.update(states)
            self.calibration = calibrate(
                depth.mode[:2],
                color.mode[:2],
                (depth.horizontal_fov, color.horizontal_fov),
                self._options,
                registered=registered,
            )
            self._streams = (depth, color)
            self._pair_within(pairing_limit_s, max(stream.mode.fps for stream in self._streams))

    @property
    def _is_gone(self) -> bool:
        return DeviceState.ERROR in self._device.states

    def _take_pair(self, timeout_s: float) -> tuple[Image, Image] | None:
        stream = wait_for_any(self._device.library, self._streams, timeout_s)
        # A stale image may follow the disconnection.
        if stream is None or self._is_gone:
            return None
        is_depth = stream.sensor == Sensor.DEPTH
        try:
            image = stream.take()
        except FrameFormatError:
            if is_depth and self._last_number is not None:
                # It is not missed, too.
                self._last_number += 1
            raise
        if image is None:
            time.sleep(_EMPTY_S)
            return None
        return self._add(image, is_depth=is_depth)

    def _frame(self, depth: Image, color: Image) -> RGBDFrame:
        return frame_of(
            self._index,
            self._clock.timestamp_us(depth.timestamp_us),
            depth.pixels,
            color.pixels,
            self.calibration,
            tenths=self._options.depth_unit == "100um",
            flips=self._flips,
        )

    def _close(self) -> None:
        self._device.close()
