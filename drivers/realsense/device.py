"""A RealSense camera through its SDK, as a source of frames."""

import contextlib
import logging
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.closing import closed_on_error
from nurbseg.common.depth import millimeters
from nurbseg.common.errors import (
    DeviceNotFoundError,
    DriverError,
    FrameFormatError,
)
from nurbseg.common.frame import Calibration, RGBDFrame
from nurbseg.common.limits import STAMP_END_NS
from nurbseg.drivers.gravity import gravity_of
from nurbseg.drivers.live.device_clock import DeviceClock
from nurbseg.drivers.live.paired_camera import Image, PairedCamera
from nurbseg.drivers.options import DeviceOptions, parse_mode
from nurbseg.drivers.realsense import sdk

logger = logging.getLogger(__name__)

#: Images that the SDK keeps for us.
_QUEUED = 8
#: Readings that the SDK keeps for us: those of a frame are at most 14.
_READINGS_QUEUED = 64
#: A reading counts for so long, seconds, if no other comes.
_KEPT_S = 0.1


class RealSenseSource(PairedCamera):
    """Frames of a RealSense.

    Depth is as the camera delivers it, not registered, in millimeters by the scale that it states; so are the
    cameras and their transform. The direction of gravity is that of its accelerometer, if it has one.
    `wanted` is a serial number, or "any". Parameters and errors are those of
    `nurbseg.drivers.openni2.device.DeviceSource`.
    """

    start_limit_s = 10.0

    def __init__(
        self,
        wanted: str = "any",
        options: DeviceOptions | None = None,
        pairing_limit_s: float = 0.02,
    ) -> None:
        super().__init__(options)
        self._rs = rs = sdk.load()
        self._was_removed = False
        self._streaming: list[Any] = []
        self._context, self._device = sdk.find(rs, self._options.serial or wanted)
        self._listing = listing = sdk.describe(rs, self._device)
        self._name = listing.name or "RealSense"
        modes = {kind: parse_mode(getattr(self._options, f"{kind}_mode")) for kind in ("depth", "color")}
        chosen = {kind: sdk.choose_profile(self._device, kind, mode) for kind, mode in modes.items()}
        unit_m = chosen["depth"][0].as_depth_sensor().get_depth_scale()
        if not 0 < unit_m < math.inf:
            raise DriverError(f"{self._name}: states a depth unit of {unit_m:g} m; plug it in again")
        self._units_per_meter = 1.0 / unit_m
        self.calibration = self._calibrated(chosen["depth"][1], chosen["color"][1])
        self.metadata.update(self._described())
        self._clock = DeviceClock(self._name)
        self._pair_within(pairing_limit_s, max(mode[2] for mode in modes.values()))
        self._queue = rs.frame_queue(_QUEUED)
        for doubt in listing.doubts:
            logger.warning("%s %s", self._name, doubt)
        with closed_on_error(self.close):
            self._context.set_devices_changed_callback(self._note_change)
            self._configure(chosen["color"][0])
            self._start(chosen)
            self._accelerometer = _Accelerometer(rs, self._device, chosen["depth"][1], self._name)
            self._streaming += self._accelerometer.streaming

    @property
    def _is_gone(self) -> bool:
        return self._was_removed

    def _described(self) -> dict[str, str]:
        return {
            "device": self._name,
            "family": "realsense",
            "uri": f"realsense:{self._listing.serial}",
            "usb_id": f"8086:{self._listing.product.lower()}",
            "usb_port": self._listing.port,
            "serial": self._listing.serial,
            "driver_version": self._listing.firmware,
            "sdk_version": str(getattr(self._rs, "__version__", "")),
            "usb": self._listing.usb,
            "depth_unit": f"{self._units_per_meter:g} per meter (the camera's)",
        }

    def _calibrated(self, depth: Any, color: Any) -> Calibration:
        if self._options.calibration is None:
            return sdk.calibration_of(self._name, depth, color)
        from nurbseg.drivers.calibration.file import read_camera_file

        sizes = [
            (each.as_video_stream_profile().width(), each.as_video_stream_profile().height())
            for each in (depth, color)
        ]
        cameras = read_camera_file(Path(self._options.calibration))
        return cameras.calibration(depth_size=sizes[0], color_size=sizes[1])

    def _configure(self, color: Any) -> None:
        """Set what the user asks of the color camera; says what the camera does not accept."""
        for name, value in self._options.color_controls.items():
            key = getattr(self._rs.option, name.replace("auto", "enable_auto"))
            try:
                color.set_option(key, float(value))
            except RuntimeError as err:
                logger.warning("%s does not accept %s %g (%s)", self._name, key.name, value, err)
        if self._options.mirror:
            logger.warning("%s does not mirror its images", self._name)

    def _start(self, chosen: Mapping[str, tuple[Any, Any]]) -> None:
        """Start the streams; some cameras have both in one sensor."""
        by_name: dict[str, tuple[Any, list[Any]]] = {}
        for sensor, profile in chosen.values():
            name = sensor.get_info(self._rs.camera_info.name)
            by_name.setdefault(name, (sensor, []))[1].append(profile)
        try:
            for sensor, profiles in by_name.values():
                sensor.open(profiles if len(profiles) > 1 else profiles[0])
                self._streaming.append(sensor)
                sensor.start(self._queue)
        except RuntimeError as err:
            # Another program has it, or it is no longer there.
            raise DeviceNotFoundError(f"{self._name}: cannot be started ({err})") from err

    def _note_change(self, changes: Any) -> None:
        """Take note of a disconnection; called on a thread of the SDK."""
        with contextlib.suppress(RuntimeError):
            self._was_removed |= bool(changes.was_removed(self._device))

    def _take_pair(self, timeout_s: float) -> tuple[Image, Image] | None:
        has_come, frame = self._queue.try_wait_for_frame(round(1000 * timeout_s))
        if not has_come:
            return None
        profile = frame.get_profile()
        is_depth = profile.stream_type() == self._rs.stream.depth
        number, time_ms = frame.get_frame_number(), frame.get_timestamp()
        if not 0 <= time_ms < STAMP_END_NS * 1e-6:
            raise FrameFormatError(
                f"{'depth' if is_depth else 'color'} frame {number}: its time is {time_ms:g} ms"
            )
        # Copied, since the SDK uses its memory again.
        pixels = np.array(frame.get_data())
        if not is_depth:
            pixels = _rgb(pixels, profile.format().name)
        return self._add(Image(round(1000 * time_ms), number, pixels), is_depth=is_depth)

    def _frame(self, depth: Image, color: Image) -> RGBDFrame:
        depth_mm = millimeters(depth.pixels, units_per_meter=round(self._units_per_meter, 3))
        timestamp_ns = 1000 * self._clock.timestamp_us(depth.timestamp_us)
        gravity = self._accelerometer.gravity()
        return RGBDFrame(self._index, timestamp_ns, depth_mm, color.pixels, self.calibration, gravity=gravity)

    def _close(self) -> None:
        for sensor in self._streaming:
            # Of a camera that was unplugged they fail.
            for end in (sensor.stop, sensor.close):
                with contextlib.suppress(RuntimeError):
                    end()


class _Accelerometer:
    """Reads the accelerometer of an open device, if it has one that states how it lies.

    `streaming` is its sensor, which whoever owns the device stops and closes; empty without one.
    """

    def __init__(self, rs: Any, device: Any, depth: Any, name: str) -> None:
        self.streaming: list[Any] = []
        self._queue = rs.frame_queue(_READINGS_QUEUED)
        self._gravity: NDArray[np.float64] | None = None
        self._read_s = -np.inf
        found = sdk.accelerometer(rs, device, depth)
        if found is None:
            return
        sensor, profile, self._depth_from_sensor = found
        try:
            sensor.open(profile)
            self.streaming.append(sensor)
            sensor.start(self._queue)
        except RuntimeError as err:
            # On Linux its files often lack a udev rule, while the cameras work.
            logger.warning(
                "%s: its accelerometer cannot be started (%s); where down is, is not known", name, err
            )

    def gravity(self) -> NDArray[np.float64] | None:
        """Return where down is in the depth camera's frame, by the readings since the last call."""
        readings = []
        while frame := self._queue.poll_for_frame():
            reading = frame.as_motion_frame().get_motion_data()
            readings.append((reading.x, reading.y, reading.z))
        if readings:
            self._gravity = gravity_of(np.mean(readings, axis=0), self._depth_from_sensor)
            self._read_s = time.monotonic()
        return self._gravity if time.monotonic() - self._read_s < _KEPT_S else None


def _rgb(pixels: NDArray[Any], form: str) -> NDArray[np.uint8]:
    if form == "rgb8":
        return pixels
    import cv2  # late: most cameras deliver RGB

    if form == "yuyv":
        pairs = pixels.view(np.uint8).reshape(*pixels.shape[:2], 2)
        return np.asarray(cv2.cvtColor(pairs, cv2.COLOR_YUV2RGB_YUY2), np.uint8)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)
