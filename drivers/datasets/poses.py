"""Poses of the camera that stand beside the images of a recording."""

import logging
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import RecordingFormatError
from nurbseg.common.files import read_file, visible
from nurbseg.common.frame import rigid
from nurbseg.common.limits import LIST_BYTES_MAX, LIST_LINES_MAX, TEXT_BYTES_MAX
from nurbseg.common.structured_text import decode_text
from nurbseg.drivers.datasets.pairs import ImagePair
from nurbseg.drivers.source import FRAME_INTERVAL_NS

_log = logging.getLogger(__name__)

#: The list of poses in a folder of TUM's layout; and how far a pose may be from an image, seconds.
_TRAJECTORY, _NEAR_S = "groundtruth.txt", 0.02
#: Replica's list of poses, which stands beside the folder of its images, and Stray Scanner's table.
REPLICA_POSES, REPLICA_IMAGES, _TABLE = "traj.txt", "results", "odometry.csv"
#: What the table's first versions wrote without a header, a line for each frame.
_COLUMNS = ["x", "y", "z", "qx", "qy", "qz", "qw"]
#: A camera of OpenGL or ARKit looks along -z with y up, ours along z with y down.
OPENGL_FROM_OURS = np.diag([1.0, -1.0, -1.0, 1.0])
#: Turns upside down what runs upward.
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def poses_of_pairs(folder: Path, pairs: Sequence[ImagePair]) -> list[NDArray[np.float64] | Path | None]:
    """Return the (4, 4) world_from_camera of each frame, or the file that has it; None where there is none.

    7-Scenes has ``frame-000000.pose.txt`` beside the images, ScanNet's reader ``pose/0.txt``. Replica and
    Stray Scanner have a line for each number of a frame, both of a camera that looks along z.
    """
    listed: dict[int, NDArray[np.float64]] = {}
    if (folder / _TABLE).is_file():
        listed = _poses_of_list(folder / _TABLE)
    elif folder.name == REPLICA_IMAGES and (folder.parent / REPLICA_POSES).is_file():
        listed = _poses_of_list(folder.parent / REPLICA_POSES)
    numbers = [int(pair.name) if re.fullmatch("[0-9]{1,9}", pair.name) else -1 for pair in pairs]
    return [
        _pose_file(folder, pair) or listed.get(number) for pair, number in zip(pairs, numbers, strict=True)
    ]


def _pose_file(folder: Path, pair: ImagePair) -> Path | None:
    name = pair.depth.stem.removesuffix(".depth")
    beside = (pair.depth.with_name(f"{name}.pose.txt"), folder / "pose" / f"{name}.txt")
    return next((camera for camera in beside if camera.is_file()), None)


def _poses_of_list(path: Path) -> dict[int, NDArray[np.float64]]:
    """Return the poses in a list by their frames' numbers; lines without one are passed over, and said."""
    from scipy.spatial.transform import Rotation  # late: few recordings have poses

    text = decode_text(read_file(path, LIST_BYTES_MAX, what="list"), "replace")
    rows = [line.replace(",", " ").split() for line in text.splitlines()[:LIST_LINES_MAX] if line.strip()]
    columns = rows.pop(0) if path.name == _TABLE and rows and "qw" in rows[0] else _COLUMNS
    found, bad = {}, 0
    for line, row in enumerate(rows):
        try:
            if path.name == _TABLE:
                named = dict(zip(columns, map(float, row), strict=True))
                pose = np.eye(4)
                pose[:3, 3] = [named[name] for name in _COLUMNS[:3]]
                pose[:3, :3] = Rotation.from_quat([named[name] for name in _COLUMNS[3:]]).as_matrix()
                line = int(named.get("frame", line))
            else:
                pose = np.array(row, dtype=np.float64).reshape(4, 4)
            found[line] = rigid(str(path), pose)
        except (ValueError, KeyError, OverflowError):
            bad += 1
    if bad:
        _log.warning("%s: %d lines are no pose, and their frames have none", path, bad)
    return found


def pose_of_file(path: Path) -> NDArray[np.float64] | None:
    """Return the pose in a file; None if it holds none: where tracking was lost, ScanNet has -inf."""
    with suppress(RecordingFormatError, OSError, ValueError):
        words = decode_text(read_file(path, TEXT_BYTES_MAX, what="pose")).split()
        if len(words) == 16:
            return rigid(str(path), np.array(words, dtype=np.float64).reshape(4, 4))
    return None


def poses_at(
    folder: Path, moments_ns: Sequence[int], *, upward: bool = False
) -> list[NDArray[np.float64] | None]:
    """Return the poses of a TUM folder's trajectory nearest to some moments, None where none is near.

    Its lines are ``seconds tx ty tz qx qy qz qw``: meters and a quaternion, world_from_camera of the color
    camera [1]_. ICL-NUIM's ``livingRoom0.gt.freiburg`` has numbers of frames in place of seconds, and poses
    of a camera whose images run upward [2]_; where ours do not (`upward`), its world is mirrored with it.

    References
    ----------
    .. [1] J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.
    .. [2] A. Handa et al., "A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM", ICRA 2014.
    """
    from scipy.spatial.transform import Rotation  # late: few recordings have poses

    path = folder / _TRAJECTORY
    rendered = [] if path.is_file() else visible(folder, "*.gt.freiburg")
    if len(rendered) == 1:
        path = rendered[0]
    if not path.is_file():
        return [None] * len(moments_ns)
    rows, bad = [], 0
    for line in decode_text(read_file(path, LIST_BYTES_MAX, what="list"), "replace").splitlines()[
        :LIST_LINES_MAX
    ]:
        if words := line.partition("#")[0].replace(",", " ").split():
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
    if rendered:
        table[:, 0] *= 1e-9 * FRAME_INTERVAL_NS
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
        if rendered and not upward:
            pose = _MIRROR @ pose @ _MIRROR
        poses.append(pose if gap_s <= _NEAR_S else None)
    return poses
