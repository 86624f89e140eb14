"""A depth camera through OpenNI2, as a source of frames."""

import logging
import time
from collections.abc import Mapping
from pathlib import Path

from nurbseg.drivers.calibration.cameras import calibration_table
from nurbseg.drivers.closing import closed_on_error
from nurbseg.drivers.errors import DeviceLostError, DriverError, FrameTimeoutError
from nurbseg.drivers.frame import RGBDFrame
from nurbseg.drivers.openni2.capi import DeviceState, Sensor
from nurbseg.drivers.openni2.configuration import calibrate, configure, set_modes
from nurbseg.drivers.openni2.device_clock import DeviceClock
from nurbseg.drivers.openni2.oni.recorder import OniRecorder
from nurbseg.drivers.openni2.opened import describe, open_camera
from nurbseg.drivers.openni2.options import DeviceOptions
from nurbseg.drivers.openni2.stream import Image, Stream, frame_of, wait_for_any
from nurbseg.drivers.source import FrameSource

logger = logging.getLogger(__name__)

#: Longest single wait in the library, seconds: how late an unplugged camera is noticed.
_SLICE_S = 0.1
#: A camera may take this long to deliver its first frames, seconds.
_START_LIMIT_S = 5.0
#: Pairs dropped after the settings were applied: they were still taken with the previous ones.
_SETTLING_PAIRS = 2
#: Images of a stream that wait for their other halves: of two rates, the slower one's may come much later.
_WAITING_MAX = 3


class DeviceSource(FrameSource):
    """Frames of a camera, each a depth image and the color image taken with it.

    Frames are not queued: a late reader gets the newest, and `missed` counts the others. Depth and color are
    paired by the device's time; `half_pairs` counts the images whose other half never came. Parameters and
    errors are those of `nurbseg.drivers.openni2.isolated.source.IsolatedCamera`, which reads one of these in
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
        self._silent_s = 0.0
        self._waiting: dict[Sensor, list[Image]] = {Sensor.DEPTH: [], Sensor.COLOR: []}
        self._recorder: OniRecorder | None = None
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
            period_us = min(stream.mode.period_us for stream in self._streams)
            self._pairing_limit_us = min(round(pairing_limit_s * 1e6), period_us // 2 + 1000)

    @property
    def losses(self) -> Mapping[str, int]:
        """Depth images never seen here, and images whose other half never came."""
        return {"missed": self.missed, "half_pairs": self.half_pairs}

    def start_recording(self, path: Path, *, lossy: bool = False) -> None:
        """Record with OpenNI2's recorder to an .oni file, which must not exist, from the next frame on.

        The streams stop for a moment. Like `read`, this is for the one thread that reads. Where `lossy`,
        color is packed as JPEG; depth never is. Raises DriverError if it cannot be recorded to, or a
        recording is being made already, and DeviceLostError if the camera is gone.
        """
        self._check_present()
        if self._recorder is not None:
            raise DriverError(f"{self._recorder.path}: is being recorded; stop that first")
        for stream in self._streams:
            stream.stop()
        try:
            self._recorder = OniRecorder(self._device, path, lossy=lossy)
        finally:
            for stream in self._streams:
                stream.start()
            # Some devices forget it when their streams stop.
            wanted = self._applied.registered
            if self._device.register(wanted) != wanted:
                logger.warning("%s lost its registration as the recording began", self.metadata["device"])
            for images in self._waiting.values():
                images.clear()
            self._last_number = None

    def stop_recording(self) -> None:
        """Finish the recording, if there is one; RecordingFormatError says that it could not be finished."""
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            recorder.close(
                {
                    "registered": self._applied.registered,
                    "calibration": calibration_table(self.calibration),
                    "device": self.metadata,
                }
            )

    def _read(self, timeout_s: float) -> RGBDFrame:
        deadline = time.monotonic() + timeout_s
        while True:
            self._check_present()
            begun = time.monotonic()
            wait_s = min(max(deadline - begun, 0.0), _SLICE_S)
            stream = wait_for_any(self._device.library, self._streams, wait_s)
            # A stale image may follow the disconnection.
            image = None if stream is None or self._is_gone else stream.take()
            pair = None if stream is None or image is None else self._add(stream, image)
            if pair is None:
                now = time.monotonic()
                self._silent_s += now - begun
                if now >= deadline:
                    self._check_present()
                    raise FrameTimeoutError(
                        f"{self.metadata['device']}: no depth and color within {timeout_s:g} s"
                    )
                continue
            self._silent_s = 0.0
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
            raise DeviceLostError(f"{name}: no depth and color for {limit_s:g} s")

    def _add(self, stream: Stream, image: Image) -> tuple[Image, Image] | None:
        """Add an image; return the pair of depth and color that it completes, if any."""
        if self._recorder is not None:
            self._recorder.see(stream.sensor, image)
        if stream.sensor == Sensor.DEPTH:
            if self._last_number is not None and not self._settling:
                self.missed += max(0, image.number - self._last_number - 1)
            self._last_number = image.number
        waiting = self._waiting[stream.sensor]
        others = self._waiting[Sensor.COLOR if stream.sensor == Sensor.DEPTH else Sensor.DEPTH]
        gaps_us = [abs(each.timestamp_us - image.timestamp_us) for each in others]
        if not gaps_us or min(gaps_us) > self._pairing_limit_us:
            self.half_pairs += len(waiting) == _WAITING_MAX
            waiting[:] = [*waiting, image][-_WAITING_MAX:]
            return None
        nearest = gaps_us.index(min(gaps_us))
        other = others[nearest]
        # The other halves of older ones can no longer come.
        self.half_pairs += len(waiting) + nearest
        waiting.clear()
        del others[: nearest + 1]
        return (image, other) if stream.sensor == Sensor.DEPTH else (other, image)

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
        try:
            self.stop_recording()
        finally:
            self._device.close()
