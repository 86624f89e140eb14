"""Cameras of data sets that bring no file of them: what their authors state, or what their clouds show."""

import logging
import re
from pathlib import Path

import numpy as np

from nurbseg.common.errors import RecordingFormatError
from nurbseg.common.files import with_suffix
from nurbseg.common.frame import Calibration
from nurbseg.drivers.calibration.cameras import CameraFile, CameraModel
from nurbseg.drivers.datasets.pcd import fit_camera
from nurbseg.drivers.datasets.pcd_file import read_pcd

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
