"""An Orbbec camera (Gemini, Femto, Astra 2) through pyorbbecsdk2: ``orbbec:`` or ``orbbec:SERIAL``.

Depth is in its own camera's pixels; nurbseg registers it. Run with a simulated camera
only, never with a real one or its SDK.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nurbseg.drivers import (
    Calibration,
    DeviceNotFoundError,
    FrameSource,
    FrameTimeoutError,
    Intrinsics,
    RGBDFrame,
    SourceOptions,
)


class OrbbecCamera(FrameSource):
    """Depth and color of the modes that the camera prefers."""

    live = True

    def __init__(self, rest: str, options: SourceOptions) -> None:
        super().__init__()
        import pyorbbecsdk as ob

        devices = ob.Context().query_devices()
        serials = [devices.get_device_serial_number_by_index(n) for n in range(devices.get_count())]
        if not serials or rest not in ("", *serials):
            present = ", ".join(serials) or "none"
            raise DeviceNotFoundError(f"orbbec:{rest}: no such camera; connected: {present}")
        device = devices.get_device_by_serial_number(rest or serials[0])
        self._pipeline = ob.Pipeline(device)
        config = ob.Config()
        config.enable_video_stream(ob.OBStreamType.DEPTH_STREAM, format=ob.OBFormat.Y16)
        config.enable_video_stream(ob.OBStreamType.COLOR_STREAM, format=ob.OBFormat.RGB)
        config.set_frame_aggregate_output_mode(ob.OBFrameAggregateOutputMode.FULL_FRAME_REQUIRE)
        self._pipeline.enable_frame_sync()
        self._pipeline.start(config)
        found = self._pipeline.get_camera_param()
        color_from_depth = np.eye(4)
        color_from_depth[:3, :3] = np.reshape(found.transform.rot, (3, 3))
        color_from_depth[:3, 3] = np.ravel(found.transform.transform) / 1000  # millimeters
        self.calibration = Calibration(
            _intrinsics(found.depth_intrinsic, found.depth_distortion),
            _intrinsics(found.rgb_intrinsic, found.rgb_distortion),
            color_from_depth,
        )
        info = device.get_device_info()
        self.metadata = {"device": info.get_name(), "serial": info.get_serial_number()}
        self._count = 0

    def _read(self, timeout_s: float) -> RGBDFrame:
        images = self._pipeline.wait_for_frames(max(1, round(1000 * timeout_s)))
        if images is None:
            raise FrameTimeoutError(f"{self.metadata['device']}: no depth and color within {timeout_s:g} s")
        depth, color = images.get_depth_frame(), images.get_color_frame()
        stored = np.frombuffer(depth.get_data(), np.uint16).reshape(depth.get_height(), depth.get_width())
        depth_mm = np.rint(stored * depth.get_depth_scale())  # units of so many millimeters
        frame = RGBDFrame(
            index=self._count,
            timestamp_ns=1000 * depth.get_timestamp_us(),
            depth_mm=np.where(depth_mm < 65535, depth_mm, 0).astype(np.uint16),
            color=np.array(color.get_data()).reshape(color.get_height(), color.get_width(), 3),
            calibration=self.calibration,
        )
        self._count += 1
        return frame

    def _close(self) -> None:
        self._pipeline.stop()


def _intrinsics(camera: Any, lens: Any) -> Intrinsics:
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    distortion = np.array([getattr(lens, name) for name in names])
    return Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, distortion)
