"""Finds the calibration of a folder's images: the user's, or a file beside them."""

import logging
from dataclasses import replace
from pathlib import Path

from nurbseg.common.errors import CalibrationError
from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.calibration.file import read_camera_file
from nurbseg.drivers.options import SourceOptions

_log = logging.getLogger(__name__)

_TOML = "camera.toml"
#: The only names that are looked for; the first found counts.
NAMES = (
    _TOML,
    "calibration.xml",
    "calibration.yml",
    "calibration.yaml",
    "intrinsics.txt",
    "camera-intrinsics.txt",
    "camera_info.yaml",
)


def find_cameras(folder: Path, options: SourceOptions, size: tuple[int, int] | None) -> CameraFile:
    """Return the cameras of a folder's images: as the user says, else by a calibration file in it.

    Where the user gives cameras, ``camera.toml`` still states the depth's unit. `size` is the width and
    height of the depth images, for the message. Raises CalibrationError if there is no calibration, or it is
    unusable.
    """
    cameras = options.given_cameras()
    found = [folder / name for name in NAMES if (folder / name).is_file()]
    if cameras is not None:
        if cameras.depth_unit is None and found and found[0].name == _TOML:
            cameras = replace(cameras, depth_unit=read_camera_file(found[0]).depth_unit)
        return cameras
    if not found:
        width, height = size or (640, 480)
        focal = 525.0 * width / 640
        kinect = f"{focal:g},{focal:g},{(width - 1) / 2:g},{(height - 1) / 2:g}"
        raise CalibrationError(
            f"{folder}: no calibration: give the camera's fx,fy,cx,cy in pixels, of a Kinect or Xtion about "
            f"--intrinsics {kinect}, or --calibration FILE, or put one of these there: {', '.join(NAMES)}"
        )
    if len(found) > 1:
        _log.warning("%s counts; not read: %s", found[0], ", ".join(path.name for path in found[1:]))
    return read_camera_file(found[0])
