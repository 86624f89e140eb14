"""Depth images that ``numpy.save`` wrote as one array, (N, H, W), mm or meters: ``npy-stack:FILE``.

nurbseg-live --replay npy-stack:depth.npy --intrinsics 525,525,319.5,239.5
"""

from __future__ import annotations

import numpy as np

from nurbseg.drivers import (
    CalibrationError,
    DeviceNotFoundError,
    EndOfRecordingError,
    FrameSource,
    RecordingFormatError,
    RGBDFrame,
    SourceOptions,
)


class NpyStack(FrameSource):
    """A recording without color; its camera is what the user says."""

    seekable = True

    def __init__(self, rest: str, options: SourceOptions) -> None:
        super().__init__()
        self._next = 0
        try:
            # Mapped, so that a stack may be larger than the memory; nothing in it is run.
            self._stack = np.load(rest, mmap_mode="r", allow_pickle=False)
        except FileNotFoundError as err:
            raise DeviceNotFoundError(f"{rest}: no such file") from err
        except (OSError, ValueError, EOFError) as err:
            raise RecordingFormatError(f"{rest}: is no array of numpy.save ({err})") from err
        if self._stack.ndim != 3 or 0 in self._stack.shape:
            raise RecordingFormatError(f"{rest}: expected (N, H, W) depth, got {self._stack.shape}")
        cameras = options.given_cameras()
        if cameras is None:
            raise CalibrationError(f"{rest}: has no calibration: give --intrinsics FX,FY,CX,CY")
        size = self._stack.shape[2], self._stack.shape[1]
        self.calibration = cameras.calibration(depth_size=size, color_size=size)
        self.metadata = {"format": "stack of depth images", "frames": str(len(self._stack))}

    def _read(self, timeout_s: float) -> RGBDFrame:
        if self._next >= len(self._stack):
            raise EndOfRecordingError(f"end after {len(self._stack)} frames")
        depth = self._stack[self._next]
        camera = self.calibration.depth
        frame = RGBDFrame.from_arrays(
            depth,
            np.full((*depth.shape, 3), 128, np.uint8),
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            index=self._next,
            timestamp_ns=self._next * 33_333_333,
        )
        self._next += 1
        return frame

    def _seek(self, index: int) -> None:
        self._next = min(index, len(self._stack) - 1)

    def _close(self) -> None:
        del self._stack
