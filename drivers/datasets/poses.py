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
    for line in decode_text(read_file(path, LIST_BYTES_MAX, what="list"), "replace").splitlines()[
        :LIST_LINES_MAX
    ]:
        if words := line.partition("#")[0].split():
            try:
                row = np.array(words[:8], dtype=np.float64)
                is_pose = len(row) == 8 and np.isfinite(row).all() and 0.9 < np.linalg.norm(row[4:]) < 1.1
            except ValueError:
                is_pose = False
            bad += not is_pose
            if is_pose:
                rows.append(row)
    if bad:
        _log.warning("%s: %d lines are no pose (seconds tx ty tz qx qy qz qw)", path, bad)
    if not rows:
        return [None] * len(moments_ns)
    table = np.array(sorted(rows, key=lambda row: float(row[0])))
    moments_s = 1e-9 * np.array(moments_ns, dtype=np.float64)
    after = np.clip(np.searchsorted(table[:, 0], moments_s), 1, max(1, len(table) - 1))
    near = np.stack([after - 1, np.minimum(after, len(table) - 1)])
    gaps_s = np.abs(table[near, 0] - moments_s)
    chosen = near[gaps_s.argmin(axis=0), np.arange(len(moments_s))]
    if gaps_s.min() > _NEAR_S:
        _log.warning("%s: no pose is within %g s of an image: are its times seconds?", path, _NEAR_S)
    poses: list[NDArray[np.float64] | None] = []
    for row, gap_s in zip(table[chosen], gaps_s.min(axis=0), strict=True):
        pose = np.eye(4)
        pose[:3, 3], pose[:3, :3] = row[1:4], Rotation.from_quat(row[4:]).as_matrix()
        poses.append(pose if gap_s <= _NEAR_S else None)
    return poses
