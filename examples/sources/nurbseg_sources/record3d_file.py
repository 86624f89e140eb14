"""A recording of the app Record3D (iPhone, iPad): ``record3d:FILE.r3d``.

The file is a zip of ``metadata`` (JSON), and for each frame ``rgbd/N.jpg`` and ``rgbd/N.depth``: float32
meters in color's geometry at fewer pixels, compressed by LZFSE. Read with files that programs wrote in the
app's form, never with a file of the app.
"""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from nurbseg.drivers import (
    Calibration,
    DeviceNotFoundError,
    EndOfRecordingError,
    FrameFormatError,
    FrameSource,
    Intrinsics,
    RecordingFormatError,
    RGBDFrame,
    SourceOptions,
)

#: ARKit's camera looks along -z, with y up; ours along z, with y down.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


class Record3DFile(FrameSource):
    """The file states everything: the cameras of each frame, the unit, the clock and the poses."""

    seekable = True

    def __init__(self, rest: str, options: SourceOptions) -> None:
        super().__init__()
        import lzfse

        self._decompress, self._next = lzfse.decompress, 0
        if not Path(rest).is_file():
            raise DeviceNotFoundError(f"{rest}: no such file")
        try:
            self._zip = zipfile.ZipFile(rest)
            self._stated: dict[str, Any] = json.loads(self._zip.read("metadata"))
            self._color_size = int(self._stated["w"]), int(self._stated["h"])
            self._depth_size = int(self._stated["dw"]), int(self._stated["dh"])
            # By columns.
            fx, _, _, _, fy, _, cx, cy, _ = self._stated["K"]
        except (zipfile.BadZipFile, KeyError, TypeError, ValueError) as err:
            raise RecordingFormatError(f"{rest}: is no recording of Record3D ({err})") from err
        self._path, self._cameras = rest, self._stated.get("perFrameIntrinsicCoeffs") or []
        self._whole = float(fx), float(fy), float(cx), float(cy)
        self._frames = sum(name.endswith(".depth") for name in self._zip.namelist())
        self.calibration = self._calibration(0)
        self.metadata = {"format": "Record3D", "frames": str(self._frames)}

    def _calibration(self, index: int) -> Calibration:
        fx, fy, cx, cy = self._cameras[index] if index < len(self._cameras) else self._whole
        color = Intrinsics(*self._color_size, fx, fy, cx, cy)
        return Calibration(color.scaled_to(*self._depth_size), color)

    def _read(self, timeout_s: float) -> RGBDFrame:
        if self._next >= self._frames:
            raise EndOfRecordingError(f"end after {self._frames} frames")
        # Counted first, so that a damaged frame is skipped.
        index, self._next = self._next, self._next + 1
        width, height = self._depth_size
        try:
            depth_m = np.frombuffer(self._decompress(self._zip.read(f"rgbd/{index}.depth")), "<f4")
            with Image.open(io.BytesIO(self._zip.read(f"rgbd/{index}.jpg")), formats=["JPEG"]) as image:
                color = np.array(image.convert("RGB"))
            return RGBDFrame(
                index=index,
                timestamp_ns=round(index * 1e9 / float(self._stated.get("fps", 30))),
                depth_mm=np.rint(1000 * np.nan_to_num(depth_m.reshape(height, width)))
                .clip(0, 65534)
                .astype(np.uint16),
                color=color,
                calibration=self._calibration(index),
                world_from_camera=self._pose(index),
            )
        except Exception as err:  # whatever the libraries raise for a damaged frame
            raise FrameFormatError(f"{self._path}: frame {index}: {err}") from err

    def _pose(self, index: int) -> np.ndarray | None:
        poses = self._stated.get("poses") or []
        if index >= len(poses):
            return None
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(poses[index][:4]).as_matrix(), poses[index][4:]
        return pose @ FLIP

    def _seek(self, index: int) -> None:
        self._next = min(index, self._frames - 1)

    def _close(self) -> None:
        self._zip.close()
