"""A depth camera through OpenNI2, as a source of frames."""

import logging
import time
from collections.abc import Mapping

from nurbseg.common.closing import closed_on_error
from nurbseg.common.errors import DeviceLostError, FrameFormatError, FrameTimeoutError
from nurbseg.common.frame import RGBDFrame
from nurbseg.drivers.live.device_clock import DeviceClock
from nurbseg.drivers.live.device_options import DeviceOptions
from nurbseg.drivers.live.image_pairing import ImagePairing
from nurbseg.drivers.openni2.capi import DeviceState, Sensor
from nurbseg.drivers.openni2.configuration import calibrate, configure, set_modes
from nurbseg.drivers.openni2.opened import describe, open_camera
from nurbseg.drivers.openni2.stream import Image, Stream, frame_of, wait_for_any
from nurbseg.drivers.source import FrameSource

logger = logging.getLogger(__name__)

#: Longest single wait in the library, seconds: how late an unplugged camera is noticed.
_SLICE_S = 0.1
#: Pause where the library names an image that is not there, seconds.
_EMPTY_S = 1e-3
#: A camera may take this long to deliver its first frames, seconds.
_START_LIMIT_S = 5.0
#: Pairs dropped after the settings were applied: they were still taken with the previous ones.
_SETTLING_PAIRS = 2


class DeviceSource(FrameSource):
    """Frames of a camera, each a depth image and the color image taken with it.

    Frames are not queued: a late reader gets the newest, and `missed` counts the others. Depth and color are
    paired by the device's time; `half_pairs` counts the images whose other half never came. Parameters and
    errors are those of `nurbseg.drivers.live.isolated.source.IsolatedCamera`, which reads one of these in
    a process of its own. Where `pairing_limit_s` is longer than half a period of the faster stream, that is
    the limit.
    """

    live = True

    def __init__(
        self,
        wanted: str = "any",
        options: DeviceOptions | None = None,
        *,
        pairing_limit_s: float = 0.02,
    ) -> None:
        super().__init__()
        self.missed = self.half_pairs = 0
        self._options = options or DeviceOptions()
        self._index = 0
        self._last_number: int | None = None
        self._settling = _SETTLING_PAIRS
        self._silent_s, self._problem = 0.0, ""
        self._sizes: dict[Sensor, tuple[int, int]] = {}
        self._device, listing = open_camera(wanted, self._options.serial)
        with closed_on_error(self.close):
            depth = self._device.add_stream(Sensor.DEPTH)
            color = self._device.add_stream(Sensor.COLOR)
            set_modes(depth, color, self._options)
            depth.start()
            color.start()
            self.metadata.update(describe(listing, self._device))
            self._clock = DeviceClock(self.metadata["device"])
            self._applied = configure(self._device, self._options, self.metadata["device"])
            self.metadata.update(self._applied.states)
            self.calibration = calibrate(
                depth.mode[:2],
                color.mode[:2],
                (depth.horizontal_fov, color.horizontal_fov),
                self._options,
                registered=self._applied.registered,
            )
            self._streams = (depth, color)
            self._sizes = {stream.sensor: stream.mode[:2] for stream in self._streams}
            period_us = min(stream.mode.period_us for stream in self._streams)
            limit_us = min(round(pairing_limit_s * 1e6), period_us // 2 + 1000)
            self._pairing: ImagePairing[Image] = ImagePairing(limit_us)

    @property
    def losses(self) -> Mapping[str, int]:
        """Depth images never seen here, and images whose other half never came."""
        return {"missed": self.missed, "half_pairs": self.half_pairs}

    def _read(self, timeout_s: float) -> RGBDFrame:
        deadline = time.monotonic() + timeout_s
        while True:
            self._check_present()
            begun = time.monotonic()
            wait_s = min(max(deadline - begun, 0.0), _SLICE_S)
            stream = wait_for_any(self._device.library, self._streams, wait_s)
            try:
                # A stale image may follow the disconnection.
                image = None if stream is None or self._is_gone else self._take(stream)
            except FrameFormatError as err:
                # A camera that delivers no others counts as silent.
                self._silent_s += time.monotonic() - begun
                self._problem = f" ({err})"
                raise
            pair = None if stream is None or image is None else self._add(stream, image)
            if pair is None:
                if stream is not None and image is None:
                    time.sleep(_EMPTY_S)
                now = time.monotonic()
                self._silent_s += now - begun
                if now >= deadline:
                    self._check_present()
                    raise FrameTimeoutError(
                        f"{self.metadata['device']}: no depth and color within {timeout_s:g} s"
                    )
                continue
            self._silent_s, self._problem = 0.0, ""
            if self._settling == 0:
                return self._frame(*pair)
            self._settling -= 1

    @property
    def _is_gone(self) -> bool:
        return DeviceState.ERROR in self._device.states

    def _check_present(self) -> None:
        name = f"{self.metadata['device']} at {self.metadata['uri']}"
        if self._is_gone:
            raise DeviceLostError(f"{name} was unplugged or has failed")
        limit_s = self._options.silence_limit_s
        if self._index == 0:
            limit_s = max(limit_s, _START_LIMIT_S)
        if self._silent_s > limit_s:
            raise DeviceLostError(f"{name}: no depth and color for {limit_s:g} s{self._problem}")

    def _take(self, stream: Stream) -> Image | None:
        """Take a stream's image; raises FrameFormatError if it is damaged, or not of the mode's size."""
        sensor = stream.sensor
        try:
            image = stream.take()
            if image is not None and image.pixels.shape[1::-1] != self._sizes[sensor]:
                height, width = image.pixels.shape[:2]
                raise FrameFormatError(
                    f"{sensor.name.lower()} frame {image.number}: {width}x{height} pixels, "
                    f"expected {'{}x{}'.format(*self._sizes[sensor])}"
                )
        except FrameFormatError:
            if sensor == Sensor.DEPTH and self._last_number is not None:
                # It is not missed, too.
                self._last_number += 1
            raise
        return image

    def _add(self, stream: Stream, image: Image) -> tuple[Image, Image] | None:
        """Add an image; return the pair of depth and color that it completes, if any."""
        if stream.sensor == Sensor.DEPTH:
            if self._last_number is not None and not self._settling:
                self.missed += max(0, image.number - self._last_number - 1)
            self._last_number = image.number
        before = self._pairing.dropped
        pair = self._pairing.add(image, is_depth=stream.sensor == Sensor.DEPTH)
        self.half_pairs += self._pairing.dropped - before
        return pair

    def _frame(self, depth: Image, color: Image) -> RGBDFrame:
        frame = frame_of(
            self._index,
            self._clock.timestamp_us(depth.timestamp_us),
            depth.pixels,
            color.pixels,
            self.calibration,
            tenths=self._options.depth_unit == "100um",
            flips=self._applied.flips,
        )
        self._index += 1
        return frame

    def _close(self) -> None:
        self._device.close()
