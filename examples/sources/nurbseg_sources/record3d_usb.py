"""An iPhone or iPad with the app Record3D, streaming over USB: ``record3d:`` or ``record3d:UDID``.

Depth is meters in color's geometry at fewer pixels, and the phone knows its pose. Run with a
simulated phone only, never with a real one or its library.
"""

from __future__ import annotations

import threading
import time

import numpy as np
from scipy.spatial.transform import Rotation

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

#: ARKit's camera looks along -z, with y up; ours along z, with y down.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


class Record3DPhone(FrameSource):
    """The app announces each frame by a call on a thread of its own."""

    live = True

    def __init__(self, rest: str, options: SourceOptions) -> None:
        super().__init__()
        from record3d import Record3DStream

        phones = [device for device in Record3DStream.get_connected_devices() if rest in ("", device.udid)]
        if not phones:
            raise DeviceNotFoundError(f"record3d:{rest}: no such phone; is the app in USB streaming mode?")
        self._arrived, self._stopped = threading.Event(), threading.Event()
        self._stream = Record3DStream()
        self._stream.on_new_frame = self._arrived.set
        self._stream.on_stream_stopped = self._stopped.set
        if not self._stream.connect(phones[0]):
            raise DeviceNotFoundError(f"record3d:{phones[0].udid}: cannot be connected; restart the app")
        self.metadata = {"device": "Record3D", "serial": phones[0].udid}
        self._count = 0
        # The sizes of the images are known with the first frame only.
        self._first: RGBDFrame | None = None
        self._first = self._read(5.0)
        self.calibration = self._first.calibration

    def _read(self, timeout_s: float) -> RGBDFrame:
        if self._first is not None:
            first, self._first = self._first, None
            return first
        if not self._arrived.wait(timeout_s):
            if self._stopped.is_set():
                raise DeviceLostError("Record3D: the stream has ended")
            raise FrameTimeoutError(f"Record3D: no frame within {timeout_s:g} s")
        self._arrived.clear()
        timestamp_ns = time.monotonic_ns()  # the app sends none
        depth_m, color = self._stream.get_depth_frame(), self._stream.get_rgb_frame()
        found, pose = self._stream.get_intrinsic_mat(), self._stream.get_camera_pose()
        height, width = color.shape[:2]
        camera = Intrinsics(width, height, found.fx, found.fy, found.tx, found.ty)
        depth_camera = camera.scaled_to(depth_m.shape[1], depth_m.shape[0])
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3] = Rotation.from_quat([pose.qx, pose.qy, pose.qz, pose.qw]).as_matrix()
        world_from_camera[:3, 3] = pose.tx, pose.ty, pose.tz
        frame = RGBDFrame(
            index=self._count,
            timestamp_ns=timestamp_ns,
            depth_mm=np.rint(1000 * np.nan_to_num(depth_m)).clip(0, 65534).astype(np.uint16),
            color=np.array(color),
            calibration=Calibration(depth_camera, camera),
            world_from_camera=world_from_camera @ FLIP,
        )
        self._count += 1
        return frame

    def _close(self) -> None:
        self._stream.disconnect()
