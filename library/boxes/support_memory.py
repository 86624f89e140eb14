"""The support from frame to frame: kept, and turned with the camera, while it is out of sight."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.boxes.support import PARALLEL, SAME_DISTANCE_M, Support, find_support, planes_of
from nurbseg.segmentation.config import Up
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree

#: For how long a support is kept where neither planes nor the source tell how the camera turns, seconds.
_KEPT_S = 2.0
#: In this time the area of a support that is out of sight falls to a third of it, seconds.
_FADED_S = 5.0
#: Weight of no turn against the planes of a frame: it decides what those that are seen leave open.
_NO_TURN = 1e-3


class SupportMemory:
    """Finds the support of frame after frame.

    Without a memory, whatever plane is seen beside a hidden table would be the support, and turn all boxes.

    Parameters
    ----------
    noise : float
        Standard deviation of the sensor's inverse depth, 1/m.
    side : {"auto", "top", "bottom", "left", "right"}
        The side of the image that is up, where gravity is not known.

    Attributes
    ----------
    support : Support or None
        That of the last frame, or the one before it, which is out of sight.
    """

    def __init__(self, noise: float, side: Up = "auto") -> None:
        self.support: Support | None = None
        self._noise, self._side = noise, side
        self._pose: NDArray[np.float64] | None = None
        self._unseen_s = 0.0

    def update(
        self,
        cloud: PointMap,
        tree: SegmentationTree,
        step_s: float,
        gravity: NDArray[np.float64] | None = None,
        world_from_camera: NDArray[np.float64] | None = None,
    ) -> Support | None:
        """Find the support of the next frame.

        Parameters
        ----------
        cloud, tree
            As for `planes_of`.
        step_s : float
            Time since the frame before, seconds.
        gravity : (3,) float64, optional
            The direction in which things fall, in the camera's frame.
        world_from_camera : (4, 4) float64, optional
            Pose of the camera.

        Returns
        -------
        Support or None
            None if it is not in sight.
        """
        before, pose_before, self._pose = self.support, self._pose, world_from_camera
        found = find_support(cloud, tree, noise=self._noise, gravity=gravity, side=self._side, before=before)
        area = 0.0 if before is None else before.area * math.exp(-step_s / _FADED_S)
        if found is not None:
            self._unseen_s, self.support = 0.0, replace(found, area=max(found.area, area))
        elif before is not None:
            planes = planes_of(cloud, tree, self._noise)
            turn = turn_between(before.planes, planes)
            if self._pose is not None and pose_before is not None:
                turn = self._pose[:3, :3].T @ pose_before[:3, :3]
            normal = None if turn is None else turn @ before.normal
            if gravity is not None:
                normal = -gravity
            self._unseen_s = self._unseen_s + step_s if normal is None else 0.0
            kept = replace(before, planes=planes, area=area)
            kept = kept if normal is None else replace(kept, normal=normal)
            self.support = kept if self._unseen_s <= _KEPT_S else None
        return found


def turn_between(before: NDArray[np.float64], now: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Find how the camera turned between two frames, from planes that both show.

    Parameters
    ----------
    before, now : (M, 5), (N, 5) float64
        As `planes_of` returns them.

    Returns
    -------
    (3, 3) float64 or None
        What turns directions of the frame before to this one, the smallest turn that the planes allow; None
        if no plane is seen in both.

    References
    ----------
    .. [1] W. Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Crystallographica
       A32(5), 1976.
    """
    alike = now[:, :3] @ before[:, :3].T
    alike[np.abs(now[:, 3:4] - before[:, 3]) > SAME_DISTANCE_M] = 0.0
    pairs = [(n, row.argmax()) for n, row in enumerate(alike) if row.max(initial=0.0) > PARALLEL]
    if not pairs:
        return None
    n, m = np.array(pairs).T
    weights = np.minimum(now[n, 4], before[m, 4])
    left, _, right = np.linalg.svd(
        (now[n, :3].T * weights) @ before[m, :3] + _NO_TURN * weights.sum() * np.eye(3)
    )
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)
