"""An OAK camera through depthai 3: ``oak:`` or ``oak:DEVICE-ID``.

Depth is aligned to color by the device. Run with a simulated camera only, never with a real one or its SDK.
"""

from __future__ import annotations

from datetime import timedelta

import numpy as np

from nurbseg.drivers import (
    Calibration,
    DeviceLostError,
    DeviceNotFoundError,
    FrameSource,
    FrameTimeoutError,
    Intrinsics,
    RGBDFrame,
    SourceOptions,
)

SIZE, RATE = (640, 400), 30


class OakCamera(FrameSource):
    """Color of the central camera, and stereo depth in its pixels."""

    live = True

    def __init__(self, rest: str, options: SourceOptions) -> None:
        super().__init__()
        import depthai as dai  # with this import late, its absence is an error of this camera alone

        try:
            device = dai.Device(dai.DeviceInfo(rest)) if rest else dai.Device()
        except RuntimeError as err:
            raise DeviceNotFoundError(f"oak:{rest}: no such camera ({err})") from err
        self._pipeline = pipeline = dai.Pipeline(device)
        socket = dai.CameraBoardSocket.CAM_A
        color = pipeline.create(dai.node.Camera).build(socket)
        left = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_B)
        right = pipeline.create(dai.node.Camera).build(dai.CameraBoardSocket.CAM_C)
        stereo = pipeline.create(dai.node.StereoDepth)
        sync = pipeline.create(dai.node.Sync)
        image = color.requestOutput(SIZE, dai.ImgFrame.Type.RGB888i, fps=RATE, enableUndistortion=True)
        left.requestOutput(SIZE, fps=RATE).link(stereo.left)
        right.requestOutput(SIZE, fps=RATE).link(stereo.right)
        image.link(stereo.inputAlignTo)
        image.link(sync.inputs["color"])
        stereo.depth.link(sync.inputs["depth"])
        sync.setSyncThreshold(timedelta(seconds=0.5 / RATE))
        self._queue = sync.out.createOutputQueue(maxSize=4, blocking=False)
        matrix = np.array(device.readCalibration().getCameraIntrinsics(socket, *SIZE))
        # The images are undistorted.
        camera = Intrinsics(*SIZE, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        self.calibration = Calibration.registered(camera)
        self.metadata = {"device": device.getDeviceName(), "serial": device.getDeviceId()}
        self._count = 0
        pipeline.start()

    def _read(self, timeout_s: float) -> RGBDFrame:
        try:
            images = self._queue.get(timedelta(seconds=timeout_s))
        except RuntimeError as err:  # the queue is closed when the device is gone
            raise DeviceLostError(f"{self.metadata['device']}: was unplugged or has failed ({err})") from err
        if images is None:
            raise FrameTimeoutError(f"{self.metadata['device']}: no depth and color within {timeout_s:g} s")
        depth, color = images["depth"], images["color"]
        frame = RGBDFrame(
            index=self._count,
            timestamp_ns=round(depth.getTimestampDevice().total_seconds() * 1e6) * 1000,
            depth_mm=np.array(depth.getFrame(), np.uint16),
            color=np.array(color.getFrame(), np.uint8),
            calibration=self.calibration,
        )
        self._count += 1
        return frame

    def _close(self) -> None:
        self._pipeline.stop()
