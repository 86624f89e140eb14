"""Poses of the camera that stand beside the images of a recording."""

import logging
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import RecordingFormatError
from nurbseg.common.files import read_file
from nurbseg.common.frame import rigid
from nurbseg.common.limits import LIST_BYTES_MAX, LIST_LINES_MAX, TEXT_BYTES_MAX
from nurbseg.common.structured_text import decode_text

_log = logging.getLogger(__name__)

#: The list of poses in a folder of TUM's layout; and how far a pose may be from an image, seconds.
_TRAJECTORY, _NEAR_S = "groundtruth.txt", 0.02


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
