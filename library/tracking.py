"""Measures the objects of frames that continue each other: boxes are tied to those before, and filtered."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.boxes.borders import hidden_shares, outline_pixels
from nurbseg.library.boxes.boxes import POINTS, OrientedBox, box_ends, least_variance
from nurbseg.library.boxes.completion import completed
from nurbseg.library.boxes.filtering import REMEMBERED_S, BoxStates, filtered, gain
from nurbseg.library.boxes.planar_motion import world_from_support
from nurbseg.library.boxes.support_memory import SupportMemory
from nurbseg.library.objects import LostObject, MeasuredObject, SegmentedFrame, Sigma, Track
from nurbseg.segmentation.config import Up
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Segment

#: Time between frames that have no times of their own, nanoseconds.
FRAME_INTERVAL_NS = 33_333_333
#: Objects of which less of the border is hidden show how the camera moves.
_LANDMARK_HIDDEN = 0.3
#: A vertical of its own, where there is no support, is followed within this angle (45 degrees).
_LIKE = np.cos(np.pi / 4)
#: Errors of the center and of the sides of any box, meters.
_SIGMA_CENTER_M, _SIGMA_SIDE_M = 0.0014, 0.002
#: Error of a box as a share of its longest side, and what is added where its border is hidden.
_SIGMA_SHARE, _SIGMA_HIDDEN = 0.02, 0.15
#: Shares of it that centers and sides have.
_SIGMA_CENTER, _SIGMA_SIDE = 0.25, 0.42


class ObjectTracker:
    """Measures the objects of frames that continue each other.

    Parameters
    ----------
    noise : float
        Standard deviation of the sensor's inverse depth, 1/m.
    side : {"auto", "top", "bottom", "left", "right"}
        The side of the image that is up, where gravity is not known.
    """

    def __init__(self, noise: float, side: Up = "auto") -> None:
        self._noise, self._side = noise, side
        self._lock = threading.Lock()
        self._state: BoxStates | None = None
        self._supports = SupportMemory(noise, side)
        self._now_ns = 0
        #: From the support's frame to that in which things at rest stay where they are.
        self._motion = np.eye(4)
        self._stamp_ns: int | None = None
        #: The newest frame that was measured: its points, its number, and its objects.
        self._newest: tuple[PointMap, int, tuple[MeasuredObject, ...]] | None = None

    def measure(self, result: SegmentedFrame) -> tuple[MeasuredObject, ...]:
        """Measure the objects of a frame, in the order of labels.

        The same frame is measured once. One that is older than the newest measured is measured alone.
        """
        with self._lock:
            newest = self._newest
            if newest is not None and result.cloud is newest[0]:
                return newest[2]
            if newest is not None and result.frame.index < newest[1]:
                return ObjectTracker(self._noise, self._side).measure(result)
            found = self._measure(result)
            self._newest = result.cloud, result.frame.index, found
            return found

    def lost(self, result: SegmentedFrame) -> tuple[LostObject, ...]:
        """Return the objects that were seen shortly before a frame, but not in it; none in an older frame."""
        self.measure(result)
        with self._lock:
            if self._state is None or self._newest is None or self._newest[0] is not result.cloud:
                return ()
            gone_s = (self._now_ns - self._state.last_ns) / 1e9
            found = [
                LostObject(label, lost_s)
                for label, lost_s in zip(self._state.labels.tolist(), gone_s.tolist(), strict=True)
                if lost_s > 0
            ]
        return tuple(sorted(found, key=lambda each: each.label))

    def _measure(self, result: SegmentedFrame) -> tuple[MeasuredObject, ...]:
        frame, stamp_ns = result.frame, result.frame.timestamp_ns
        step_ns = 0 if self._stamp_ns is None else stamp_ns - self._stamp_ns
        if not 0 <= step_ns <= REMEMBERED_S * 1e9:
            self._state, self._supports = None, SupportMemory(self._noise, self._side)
            self._motion = np.eye(4)
        self._stamp_ns = stamp_ns
        # Frames without times are taken to come at the usual rate.
        self._now_ns = now_ns = self._now_ns + (step_ns or FRAME_INTERVAL_NS)
        step_s = (step_ns or FRAME_INTERVAL_NS) / 1e9
        support = self._supports.update(
            result.cloud, result.tree, step_s, frame.gravity, frame.world_from_camera
        )
        groups: dict[int, list[Segment]] = {}
        object_of_leaf = result.object_of_leaf
        for leaf, label in zip(result.tree.leaves(), object_of_leaf[1:].tolist(), strict=True):
            if leaf.pixels.size and label:
                groups.setdefault(label, []).append(leaf)
        if not groups:
            return ()
        labels = np.array(sorted(groups))
        points_m, bounds = self._points(result, [groups[label] for label in labels.tolist()])
        visible = box_ends(points_m, bounds, self._ups(result, labels, points_m, bounds), self._noise)
        whole = visible if support is None else completed(visible, points_m, bounds, support, self._noise)
        distance = np.add.reduceat(points_m[:, 2], bounds[:-1]) / np.diff(bounds)
        hidden = hidden_shares(result.tree.labels("surfaces"), object_of_leaf, result.cloud, self._noise)
        hidden = hidden[labels]
        world_from_camera = self._world_from_camera(result, labels, whole.centers_m, hidden)
        if self._state is not None:
            self._state = self._state.moved(np.asarray(np.linalg.inv(world_from_camera), np.float64))
        state, remembered, sigma = filtered(self._state, labels, whole, now_ns)
        self._state = remembered.moved(world_from_camera)
        bias = (_SIGMA_HIDDEN * hidden + _SIGMA_SHARE) * state.size.max(axis=1)
        sigma[:, 0] = np.sqrt(sigma[:, 0] ** 2 + _SIGMA_CENTER_M**2 + (_SIGMA_CENTER * bias) ** 2)
        sigma[:, 1] = np.sqrt(sigma[:, 1] ** 2 + _SIGMA_SIDE_M**2 + (_SIGMA_SIDE * bias) ** 2)
        sigma[:, 2] = np.minimum(sigma[:, 2], np.pi / 2)
        center, size = visible.centers_m, visible.high - visible.low
        columns = zip(
            *(
                labels.tolist(),
                sigma.tolist(),
                state.velocity.tolist(),
                ((now_ns - state.first_ns) / 1e9).tolist(),
            ),
            *(hidden.tolist(), (self._noise * distance**2).tolist()),
            strict=True,
        )
        return tuple(
            MeasuredObject(
                label=label,
                leaves=tuple(leaf.name for leaf in groups[label]),
                box=OrientedBox(state.center[n], state.axes[n], state.size[n]),
                visible=OrientedBox(center[n], visible.axes[n], size[n]),
                sigma=Sigma(*errors),
                track=Track(tuple(velocity), seen_s),
                hidden_share=hidden_share,
                noise_m=noise_m,
                support=self._supports.support,
                cloud=result.cloud,
                tree=result.tree,
                camera=result.frame.calibration.depth,
            )
            for n, (label, errors, velocity, seen_s, hidden_share, noise_m) in enumerate(columns)
        )

    def _world_from_camera(
        self,
        result: SegmentedFrame,
        labels: NDArray[np.int64],
        center: NDArray[np.float64],
        hidden: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return where the camera is in a frame in which things at rest stay, as far as it can be told."""
        if result.frame.world_from_camera is not None:
            return result.frame.world_from_camera
        if self._supports.support is None:
            return np.eye(4)
        support_from_camera = self._supports.support.support_from_camera
        if self._state is not None:
            seen = center @ support_from_camera[:3, :3].T + support_from_camera[:3, 3]
            rows = self._state.rows_of(labels)
            own = np.flatnonzero((rows >= 0) & (hidden < _LANDMARK_HIDDEN))
            known = rows[own]
            dt = (self._now_ns - self._state.last_ns[known]) / 1e9
            expected = self._state.center[known] + self._state.velocity[known] * dt[:, None]
            self._motion = world_from_support(expected, seen[own], self._motion)
        return self._motion @ support_from_camera

    def _points(
        self, result: SegmentedFrame, groups: Sequence[Sequence[Segment]]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the points that determine the boxes of a frame's objects, and where those of each begin."""
        chosen: list[NDArray[np.intp]] = []
        bounds = [0]
        for leaves in groups:
            step = -(-sum(leaf.pixels.size for leaf in leaves) // POINTS)
            own = [outline_pixels(leaf.pixels, result.cloud, self._noise, step) for leaf in leaves]
            chosen += own
            bounds.append(bounds[-1] + sum(pixels.size for pixels in own))
        points_m = result.cloud.points_m.reshape(-1, 3).take(np.concatenate(chosen), axis=0)
        return points_m.astype(np.float64), np.array(bounds)

    def _ups(
        self,
        result: SegmentedFrame,
        labels: NDArray[np.int64],
        points_m: NDArray[np.float64],
        bounds: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Return the heights of the boxes: that of the support, or each box's own."""
        support = self._supports.support
        if support is not None:
            return np.tile(support.normal, (len(labels), 1))
        pose = result.frame.world_from_camera
        turn = np.eye(3) if pose is None else pose[:3, :3]
        spans = zip(labels.tolist(), bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)
        return np.array([self._own_up(points_m[start:end], label, turn) for label, start, end in spans])

    def _own_up(
        self, points_m: NDArray[np.float64], label: int, world_from_camera: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the height of a box without a support: where its points vary least, or nearly as before.

        The turn (3, 3) is that between the frames of the state and of the points.
        """
        up = least_variance(points_m)
        known = np.flatnonzero(self._state.labels == label) if self._state is not None else np.zeros(0, int)
        if self._state is None or not known.size:
            return up
        before = self._state.axes[known[0], 2] @ world_from_camera
        up = up if up @ before >= 0 else -up
        if up @ before < _LIKE:
            return np.asarray(before)
        up = before + gain(np.array([1 / 30]))[0] * (up - before)
        return np.asarray(up / np.linalg.norm(up))
