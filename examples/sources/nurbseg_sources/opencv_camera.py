"""Frames of a program's own, as a source: here a camera that OpenCV reads through OpenNI2, ``opencv:``.

It needs an OpenCV with OpenNI2, which the usual packages are not; run with a simulated camera only.
"""

from __future__ import annotations

import time

import cv2

from nurbseg.drivers import DeviceLostError, DeviceNotFoundError, FrameSource, RGBDFrame, SourceOptions


class OpenCVCamera(FrameSource):
    """Depth that the camera registers to color."""

    live = True

    def __init__(self, rest: str, options: SourceOptions) -> None:
        super().__init__()
        self._camera, self._count = cv2.VideoCapture(int(rest or 0), cv2.CAP_OPENNI2), 0
        if not self._camera.isOpened():
            raise DeviceNotFoundError(f"opencv:{rest}: no such camera, or no OpenNI2 in this OpenCV")
        self._camera.set(cv2.CAP_PROP_OPENNI_REGISTRATION, 1)
        self._focal_px = self._camera.get(cv2.CAP_OPENNI_DEPTH_GENERATOR_FOCAL_LENGTH)
        self.calibration = self._read(1.0).calibration

    def _read(self, timeout_s: float) -> RGBDFrame:
        if not self._camera.grab():
            raise DeviceLostError("opencv: the camera delivers nothing more")
        _, depth_mm = self._camera.retrieve(flag=cv2.CAP_OPENNI_DEPTH_MAP)
        _, bgr = self._camera.retrieve(flag=cv2.CAP_OPENNI_BGR_IMAGE)
        camera = (self._focal_px, self._focal_px, (bgr.shape[1] - 1) / 2, (bgr.shape[0] - 1) / 2)
        self._count += 1
        return RGBDFrame.from_arrays(
            depth_mm, bgr[..., ::-1], *camera, index=self._count - 1, timestamp_ns=time.time_ns()
        )

    def _close(self) -> None:
        self._camera.release()
