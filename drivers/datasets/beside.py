"""What stands beside the images of a folder: their calibration, labels, and the camera's poses."""

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import CalibrationError, FrameFormatError, RecordingFormatError
from nurbseg.common.files import read_file
from nurbseg.common.frame import Calibration, rigid
from nurbseg.common.limits import FRAME_BYTES_MAX, LIST_BYTES_MAX, LIST_LINES_MAX, TEXT_BYTES_MAX
from nurbseg.common.structured_text import decode_text
from nurbseg.drivers.calibration.cameras import CameraFile
from nurbseg.drivers.calibration.file import read_camera_file
from nurbseg.drivers.datasets.images import decode_labels
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
#: The list of poses in a folder of TUM's layout; and how far a pose may be from an image, seconds.
_TRAJECTORY, _NEAR_S = "groundtruth.txt", 0.02


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


def read_labels(path: Path, depth_mm: NDArray[np.uint16], calibration: Calibration) -> NDArray[np.uint16]:
    """Return a label image, (H, W), on the pixels of a depth image of this size.

    Raises FrameFormatError if it is unusable, or has neither the depth nor the color image's size.
    """
    content = read_file(path, FRAME_BYTES_MAX, what="image", error=FrameFormatError)
    labels = decode_labels(content, str(path))
    if labels.shape == depth_mm.shape:
        return labels
    if labels.shape == (calibration.color.height, calibration.color.width):
        return _on_depth(labels, depth_mm, calibration)
    expected = f"expected the depth image's size {depth_mm.shape[1]}x{depth_mm.shape[0]}"
    raise FrameFormatError(f"{path}: {expected}, got {labels.shape[1]}x{labels.shape[0]}")


def _on_depth(
    labels: NDArray[np.uint16], depth_mm: NDArray[np.uint16], calibration: Calibration
) -> NDArray[np.uint16]:
    """Return the label of the color pixel that shows each depth pixel's point; 0 where there is none."""
    rays, color, step = calibration.depth.rays(), calibration.color, calibration.color_from_depth
    pixels = np.flatnonzero((depth_mm > 0) & np.isfinite(rays).all(axis=-1))
    found = np.zeros(depth_mm.size, np.uint16)
    if pixels.size:
        z = depth_mm.reshape(-1, 1)[pixels] * 1e-3
        points = np.hstack([rays.reshape(-1, 2)[pixels] * z, z]).astype(np.float64)
        turn = cv2.Rodrigues(step[:3, :3])[0]
        places = cv2.projectPoints(points, turn, step[:3, 3], color.matrix, color.distortion)[0]
        columns, rows = np.rint(np.clip(places.reshape(-1, 2), -1.0, 1e6)).astype(int).T
        is_inside = (columns >= 0) & (columns < color.width) & (rows >= 0) & (rows < color.height)
        found[pixels[is_inside]] = labels[rows[is_inside], columns[is_inside]]
    return found.reshape(depth_mm.shape)


def pose_file(depth: Path) -> Path | None:
    """Return the file with the pose of ``frame-N.depth.png``, ``frame-N.pose.txt``; None if there is none."""
    beside = depth.with_name(f"{depth.stem.removesuffix('.depth')}.pose.txt")
    return beside if beside.is_file() else None


def pose_of_file(path: Path) -> NDArray[np.float64] | None:
    """Return the (4, 4) world_from_camera in a file; None if it holds none, as where tracking was lost."""
    with suppress(RecordingFormatError, OSError, ValueError):
        words = decode_text(read_file(path, TEXT_BYTES_MAX, what="pose")).split()
        if len(words) == 16:
            return rigid(str(path), np.array(words, dtype=np.float64).reshape(4, 4))
    return None


def poses_at(folder: Path, moments_ns: Sequence[int]) -> list[NDArray[np.float64] | None]:
    """Return the poses of a TUM folder's trajectory nearest to some moments, None where none is near.

    Its lines are ``seconds tx ty tz qx qy qz qw``: meters and a quaternion, world_from_camera of the color
    camera [1]_.

    References
    ----------
    .. [1] J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
    """
    from scipy.spatial.transform import Rotation  # late: few recordings have poses

    path = folder / _TRAJECTORY
    if not path.is_file():
        return [None] * len(moments_ns)
    rows, bad = [], 0
    text = decode_text(read_file(path, LIST_BYTES_MAX, what="list"), "replace")
    for line in text.splitlines()[:LIST_LINES_MAX]:
        if words := line.partition("#")[0].split():
            with suppress(ValueError):
                row = np.array(words[:8], dtype=np.float64)
                if len(row) == 8 and np.isfinite(row).all() and 0.9 < np.linalg.norm(row[4:]) < 1.1:
                    rows.append(row)
                    continue
            bad += 1
    if bad:
        _log.warning("%s: %d lines are no pose (seconds tx ty tz qx qy qz qw)", path, bad)
    if not rows:
        return [None] * len(moments_ns)
    table = np.array(sorted(rows, key=lambda row: float(row[0])))
    moments_s = 1e-9 * np.array(moments_ns, dtype=np.float64)
    nearest = table[np.searchsorted((table[1:, 0] + table[:-1, 0]) / 2, moments_s)]
    is_near = np.abs(nearest[:, 0] - moments_s) <= _NEAR_S
    if not is_near.any():
        _log.warning("%s: no pose is within %g s of an image: are its times seconds?", path, _NEAR_S)
    poses = np.tile(np.eye(4), (len(nearest), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = nearest[:, 1:4], Rotation.from_quat(nearest[:, 4:]).as_matrix()
    return [pose if near else None for pose, near in zip(poses, is_near, strict=True)]
