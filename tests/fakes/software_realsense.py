"""A RealSense without a camera: the SDK's own software device, which is given its frames."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame


def intrinsics_of(rs: Any, camera: Intrinsics) -> Any:
    values = rs.intrinsics()
    values.width, values.height = camera.width, camera.height
    values.fx, values.fy, values.ppx, values.ppy = camera.fx, camera.fy, camera.cx, camera.cy
    values.model = rs.distortion.brown_conrady
    values.coeffs = [*camera.distortion[:5].tolist(), *[0.0] * (5 - min(5, camera.distortion.size))]
    return values


class SoftwareCamera:
    """A software device with depth and color, and `send` for a pair of images."""

    def __init__(
        self,
        rs: Any,
        calibration: Calibration,
        *,
        depth_units_m: float = 0.001,
        fps: tuple[int, int] = (30, 30),
        infos: dict[str, str] | None = None,
        modes: tuple[tuple[int, int], ...] = (),
        stated: dict[str, Any] | None = None,
        sensors: int = 2,
        accelerometer_from_depth: Any = None,
    ) -> None:
        self._rs, self._units = rs, depth_units_m
        self.device = rs.software_device()
        for name, value in (infos or {}).items():
            self.device.register_info(getattr(rs.camera_info, name), value)
        names = ("Stereo Module", "RGB Camera")[:sensors]
        self.sensors = [self.device.add_sensor(name) for name in names]
        self.sensors[0].add_read_only_option(rs.option.depth_units, depth_units_m)
        self.profiles, self.others = [], []
        for place, (camera, form, kind, size) in enumerate(
            (
                (calibration.depth, rs.format.z16, rs.stream.depth, 2),
                (calibration.color, rs.format.rgb8, rs.stream.color, 3),
            )[:sensors]
        ):
            for other in (*modes, None):
                stream = rs.video_stream()
                stream.type, stream.index, stream.uid = kind, 0, 10 * place + len(self.profiles)
                own = camera if other is None else camera.scaled_to(*other)
                stream.width, stream.height, stream.fps = own.width, own.height, fps[place]
                stream.bpp, stream.fmt, stream.intrinsics = size, form, intrinsics_of(rs, own)
                for name, value in (stated or {}).items():
                    if hasattr(stream.intrinsics, name):
                        values = stream.intrinsics
                        setattr(values, name, value)
                        stream.intrinsics = values
                added = self.sensors[place].add_video_stream(stream, other is None)
                self.others.append(added.as_video_stream_profile())
            self.profiles.append(added.as_video_stream_profile())
        transform = rs.extrinsics()
        # By columns.
        transform.rotation = calibration.color_from_depth[:3, :3].T.ravel().tolist()
        transform.translation = calibration.color_from_depth[:3, 3].tolist()
        transform.rotation = (stated or {}).get("rotation", transform.rotation)
        if sensors > 1:
            self.profiles[0].register_extrinsics_to(self.profiles[1], transform)
        if accelerometer_from_depth is not None:
            self._add_accelerometer(np.asarray(accelerometer_from_depth))
        self.device.create_matcher(rs.matchers.default)
        # The SDK reads them later.
        self._sent: list[Any] = []

    def _add_accelerometer(self, turn: np.ndarray) -> None:
        rs = self._rs
        self.motion = self.device.add_sensor("Motion Module")
        added = []
        for place, (kind, fps) in enumerate(
            ((rs.stream.gyro, 200), (rs.stream.accel, 250), (rs.stream.accel, 63))
        ):
            stream = rs.motion_stream()
            stream.type, stream.index, stream.uid, stream.fps = kind, 0, 100 + place, fps
            stream.fmt = rs.format.motion_xyz32f
            added.append(self.motion.add_motion_stream(stream))
        transform = rs.extrinsics()
        # By columns.
        transform.rotation, transform.translation = turn.T.ravel().tolist(), [0.0, 0.0, 0.0]
        for each in added:
            self.profiles[0].register_extrinsics_to(each, transform)
        self.motion_profile = added[2].as_motion_stream_profile()

    def send_acceleration(self, xyz: tuple[float, float, float], number: int, time_ms: float) -> None:
        frame = self._rs.software_motion_frame()
        shown = self._rs.vector()
        shown.x, shown.y, shown.z = xyz
        frame.data, frame.timestamp, frame.frame_number = shown, time_ms, number
        frame.domain, frame.profile = self._rs.timestamp_domain.hardware_clock, self.motion_profile
        self._sent = [*self._sent[-20:], frame]
        self.motion.on_motion_frame(frame)

    def send_image(
        self, place: int, image: np.ndarray, number: int, time_ms: float, profile: Any = None
    ) -> None:
        rs = self._rs
        frame = rs.software_video_frame()
        frame.bpp = image.itemsize * (1 if image.ndim == 2 else image.shape[2])
        frame.stride = frame.bpp * image.shape[1]
        frame.pixels = np.array(image, order="C").view(np.uint8).reshape(-1)
        frame.timestamp, frame.domain = time_ms, rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.profile = number, profile or self.profiles[place]
        if place == 0:
            frame.depth_units = self._units
        self._sent = [*self._sent[-20:], frame]
        self.sensors[place].on_video_frame(frame)

    def send(self, depth: np.ndarray, color: np.ndarray, number: int, time_ms: float) -> None:
        self.send_image(0, depth, number, time_ms)
        self.send_image(1, color, number, time_ms)


def record(path: Path, frames: list[RGBDFrame], *, depth_units_m: float = 0.001) -> None:
    """Have the SDK's recorder write frames; their depth in units of `depth_units_m`."""
    import pyrealsense2 as rs

    camera = SoftwareCamera(rs, frames[0].calibration, depth_units_m=depth_units_m)
    recorder = rs.recorder(str(path), camera.device)
    queue = rs.frame_queue(100)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    for frame in frames:
        depth = np.rint(frame.depth_mm / (1000.0 * depth_units_m)).astype(np.uint16)
        camera.send(depth, frame.color, frame.index, frame.timestamp_ns * 1e-6)
        # Its queue drops what comes too fast.
        time.sleep(0.03)
    for sensor in sensors:
        sensor.stop()
        sensor.close()


if __name__ == "__main__":
    from nurbseg.drivers import open_source

    with open_source(sys.argv[2]) as source:
        record(Path(sys.argv[1]), list(source)[: int(sys.argv[3])], depth_units_m=float(sys.argv[4]))
