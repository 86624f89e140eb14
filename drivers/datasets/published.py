"""What published data sets need beyond pairs of images: their cameras, and labels of color's pixels."""

import logging
import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError, RecordingFormatError
from nurbseg.common.files import read_file, with_suffix
from nurbseg.common.frame import Calibration
from nurbseg.common.limits import FRAME_BYTES_MAX
from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel
from nurbseg.drivers.datasets.images import decode_labels

_log = logging.getLogger(__name__)

_SIZE = (640, 480)
#: ICL-NUIM's folders are called like living_room_traj0_frei_png, and its images run upwards.
_ICL_NUIM = re.compile(r"(living_?room|lr|office|of)_?(traj|kt)_?\d.*", re.IGNORECASE)
_SEVEN_SCENES = re.compile(r"seq-\d+")


def known_cameras(folder: Path) -> CameraFile | None:
    """Return the cameras of a data set's sequence; None if it is of none that is known.

    The sequences are those of 7-Scenes [1]_, of ICL-NUIM in TUM's layout [2]_, and of OCID [3]_, whose camera
    is found from its first cloud.

    References
    ----------
    .. [1] J. Shotton et al., "Scene coordinate regression forests for camera relocalization in RGB-D images",
       CVPR 2013.
    .. [2] A. Handa et al., "A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM", ICRA 2014.
    .. [3] M. Suchi et al., "EasyLabel: a semi-automatic pixel-wise object annotation tool for creating
       robotic RGB-D datasets", ICRA 2019.
    """
    name = folder.resolve().name
    if _SEVEN_SCENES.fullmatch(name) and any(folder.glob("frame-*.pose.txt")):
        _log.warning("%s: 7-Scenes' depth is not registered to color, whose camera is unknown", folder)
        return _stated("7-Scenes", 585.0, 585.0, 320.0, 240.0)
    if _ICL_NUIM.fullmatch(name) and (folder / "associations.txt").is_file():
        return _stated("ICL-NUIM", 481.2, -480.0, 319.5, 239.5)
    for path in with_suffix(folder / "pcd", ".pcd")[:1]:
        from nurbseg.drivers.datasets.pcd import fit_camera
        from nurbseg.drivers.datasets.pcd_file import read_pcd

        try:
            camera = fit_camera(read_pcd(path).points_m, str(path))
        except RecordingFormatError as err:
            _log.warning("%s", err)
            continue
        return CameraFile.of_calibration(Calibration.registered(camera), path)
    return None


def _stated(name: str, fx: float, fy: float, cx: float, cy: float) -> CameraFile:
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    camera = CameraModel(Path(name), "its authors' camera", matrix, size=_SIZE)
    return CameraFile(path=Path(name), depth=camera, color=camera)


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
    rays, color = calibration.depth.rays(), calibration.color
    measured = (depth_mm > 0) & np.isfinite(rays).all(axis=-1)
    z = depth_mm[measured, None] * 1e-3
    found = np.zeros(depth_mm.shape, np.uint16)
    if not z.size:
        return found
    points = np.hstack([rays[measured] * z, z]).astype(np.float64)
    step = calibration.color_from_depth
    turn = cv2.Rodrigues(step[:3, :3])[0]
    places = cv2.projectPoints(points, turn, step[:3, 3], color.matrix, color.distortion)[0].reshape(-1, 2)
    columns, rows = np.rint(np.clip(places, -1.0, 1e6)).astype(int).T
    is_inside = (columns >= 0) & (columns < color.width) & (rows >= 0) & (rows < color.height)
    values = np.zeros(len(points), np.uint16)
    values[is_inside] = labels[rows[is_inside], columns[is_inside]]
    found[measured] = values
    return found
