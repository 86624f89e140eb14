"""Measures the objects of frames that continue each other: boxes are tied to those before, and filtered."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.boxes.borders import hidden_shares, unmixed
from nurbseg.library.boxes.boxes import POINTS, OrientedBox, box_ends, cross, least_variance
from nurbseg.library.boxes.completion import standing, with_far_sides
from nurbseg.library.boxes.planar_motion import world_from_support
from nurbseg.library.boxes.support_memory import SupportMemory
from nurbseg.library.objects import LostObject, MeasuredObject, SegmentedFrame, Sigma, Track
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import Segment

#: Time between frames that have no times of their own, nanoseconds.
FRAME_INTERVAL_NS = 33_333_333
#: Time constant of the filter of centers, sizes and turns, seconds.
TIME_CONSTANT_S = 0.2
#: For how long an object is remembered that is not seen, seconds.
REMEMBERED_S = 2.0
#: The turn of a box counts fully from this difference of its roundness to 1, and not at all at 0.
_SQUARE = 0.25
#: Objects of which less of the border is hidden show how the camera moves.
_LANDMARK_HIDDEN = 0.3
#: A vertical of its own, where there is no support, is followed within this angle (45 degrees).
_LIKE = np.cos(np.pi / 4)
#: Error of a box whose border is seen: meters, and share of its longest side and of the hidden one.
_SIGMA_M, _SIGMA_SHARE, _SIGMA_HIDDEN = 0.002, 0.02, 0.15
#: Shares of it that centers and sides have.
_SIGMA_CENTER, _SIGMA_SIDE = 0.38, 0.42
#: The same of the turn, radians, for a box that is not round.
_SIGMA_YAW = 0.024


@dataclass(slots=True)
class _State:
    """What is remembered of each object, by its row; times are those of frames, nanoseconds."""

    labels: NDArray[np.int64]
    first_ns: NDArray[np.int64]
    last_ns: NDArray[np.int64]
    times: NDArray[np.int64]
    axes: NDArray[np.float64]
    center: NDArray[np.float64]
    velocity: NDArray[np.float64]
    size: NDArray[np.float64]
    turn_rate: NDArray[np.float64]
    #: Mean squares of the differences between measured and predicted centers, sizes and turns.
    spread: NDArray[np.float64]

    def moved(self, transform: NDArray[np.float64]) -> _State:
        """Return it in another frame, by the (4, 4) rigid transform from this one."""
        turn, shift = transform[:3, :3], transform[:3, 3]
        return replace(
            self,
            axes=self.axes @ turn.T,
            center=self.center @ turn.T + shift,
            velocity=self.velocity @ turn.T,
        )

    def rows_of(self, labels: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return the row of each label; -1 if it is new."""
        row_of = {label: row for row, label in enumerate(self.labels.tolist())}
        return np.array([row_of.get(label, -1) for label in labels.tolist()])

    def rows(self, chosen: NDArray[np.intp]) -> _State:
        return _State(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def joined(self, other: _State) -> _State:
        names = self.__dataclass_fields__
        return _State(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


@dataclass(slots=True)
class _Measured:
    """The boxes of a frame by itself, in the order of `labels`."""

    labels: NDArray[np.int64]
    axes: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    roundness: NDArray[np.float64]
    profile: NDArray[np.float64]
    distance: NDArray[np.float64]

    def centers(self) -> NDArray[np.float64]:
        """Return the middles of the boxes, (M, 3) meters."""
        return np.asarray(np.einsum("mi,mij->mj", (self.low + self.high) / 2, self.axes))


class ObjectTracker:
    """Measures the objects of frames that continue each other.

    Parameters
    ----------
    noise : float
        Standard deviation of the sensor's inverse depth, 1/m.
    """

    def __init__(self, noise: float) -> None:
        self._noise = noise
        self._lock = threading.Lock()
        self._state: _State | None = None
        self._supports = SupportMemory(noise)
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
                return ObjectTracker(self._noise).measure(result)
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
            self._state, self._supports = None, SupportMemory(self._noise)
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
        labels = sorted(groups)
        measured = self._boxes(result, [groups[label] for label in labels], np.array(labels))
        whole = replace(measured, low=measured.low.copy())
        if support is not None:
            whole.low[:, 2] = standing(support, whole.low[:, 2], whole.high[:, 2])
            whole.low, whole.high = with_far_sides(whole.axes, whole.low, whole.high, whole.profile)
        hidden = hidden_shares(result.tree.labels("surfaces"), object_of_leaf, result.cloud, self._noise)
        hidden = hidden[measured.labels]
        world_from_camera = self._world_from_camera(result, whole, hidden)
        if self._state is not None:
            self._state = self._state.moved(np.asarray(np.linalg.inv(world_from_camera), np.float64))
        others, rows = self._predicted(measured.labels, now_ns)
        state, sigma = self._updated(whole, others, rows, now_ns)
        assert self._state is not None
        self._state = self._state.moved(world_from_camera)
        bias = (_SIGMA_HIDDEN * hidden + _SIGMA_SHARE) * state.size.max(axis=1)
        sigma[:, 0] = np.sqrt(sigma[:, 0] ** 2 + _SIGMA_M**2 + (_SIGMA_CENTER * bias) ** 2)
        sigma[:, 1] = np.sqrt(sigma[:, 1] ** 2 + _SIGMA_M**2 + (_SIGMA_SIDE * bias) ** 2)
        sigma[:, 2] = np.minimum(sigma[:, 2], np.pi / 2)
        center, size = measured.centers(), measured.high - measured.low
        columns = zip(
            *(labels, sigma.tolist(), state.velocity.tolist(), ((now_ns - state.first_ns) / 1e9).tolist()),
            *(hidden.tolist(), (self._noise * measured.distance**2).tolist()),
            strict=True,
        )
        return tuple(
            MeasuredObject(
                label=label,
                leaves=tuple(leaf.name for leaf in groups[label]),
                box=OrientedBox(state.center[n], state.axes[n], state.size[n]),
                visible=OrientedBox(center[n], measured.axes[n], size[n]),
                sigma=Sigma(*errors),
                track=Track(tuple(velocity), seen_s),
                hidden_share=hidden_share,
                noise_m=noise_m,
                support=self._supports.support,
                cloud=result.cloud,
                tree=result.tree,
            )
            for n, (label, errors, velocity, seen_s, hidden_share, noise_m) in enumerate(columns)
        )

    def _world_from_camera(
        self, result: SegmentedFrame, measured: _Measured, hidden: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return where the camera is in a frame in which things at rest stay, as far as it can be told."""
        if result.frame.world_from_camera is not None:
            return result.frame.world_from_camera
        if self._supports.support is None:
            return np.eye(4)
        support_from_camera = self._supports.support.support_from_camera
        if self._state is not None:
            center = measured.centers()
            seen = center @ support_from_camera[:3, :3].T + support_from_camera[:3, 3]
            rows = self._state.rows_of(measured.labels)
            own = np.flatnonzero((rows >= 0) & (hidden < _LANDMARK_HIDDEN))
            known = rows[own]
            dt = (self._now_ns - self._state.last_ns[known]) / 1e9
            expected = self._state.center[known] + self._state.velocity[known] * dt[:, None]
            self._motion = world_from_support(expected, seen[own], self._motion)
        return self._motion @ support_from_camera

    def _boxes(
        self, result: SegmentedFrame, groups: Sequence[Sequence[Segment]], labels: NDArray[np.int64]
    ) -> _Measured:
        """Measure the boxes of a frame's objects, each of them from some of its points."""
        chosen: list[NDArray[np.intp]] = []
        counts = [0]
        for leaves in groups:
            step = -(-sum(leaf.pixels.size for leaf in leaves) // POINTS)
            pixels = np.concatenate([leaf.pixels[::step] for leaf in leaves])
            chosen.append(unmixed(pixels, result.cloud, self._noise))
            counts.append(chosen[-1].size)
        bounds = np.cumsum(counts)
        points = result.cloud.points_m.reshape(-1, 3).take(np.concatenate(chosen), axis=0).astype(np.float64)
        support = self._supports.support
        if support is not None:
            ups = np.tile(support.normal, (len(groups), 1))
        else:
            pose = result.frame.world_from_camera
            turn = np.eye(3) if pose is None else pose[:3, :3]
            spans = zip(labels.tolist(), bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)
            ups = np.array([self._own_up(points[a:b], n, turn) for n, a, b in spans])
        axes, low, high, roundness, profile = box_ends(points, bounds, ups)
        distance = np.add.reduceat(points[:, 2], bounds[:-1]) / np.diff(bounds)
        return _Measured(labels, axes, low, high, roundness, profile, distance)

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
        up = before + _gain(np.array([1 / 30]))[0] * (up - before)
        return np.asarray(up / np.linalg.norm(up))

    def _predicted(self, labels: NDArray[np.int64], now_ns: int) -> tuple[_State | None, NDArray[np.intp]]:
        """Return what is remembered of other objects, and the row of each label in the state; -1 if new."""
        state = self._state
        if state is None:
            return None, np.full(len(labels), -1)
        rows = state.rows_of(labels)
        fresh = now_ns - state.last_ns <= REMEMBERED_S * 1e9
        fresh[rows[rows >= 0]] = False
        return state.rows(np.flatnonzero(fresh)), rows

    def _updated(
        self,
        measured: _Measured,
        others: _State | None,
        rows: NDArray[np.intp],
        now_ns: int,
    ) -> tuple[_State, NDArray[np.float64]]:
        """Filter the boxes of a frame; return the state of its objects, and (M, 3) standard deviations."""
        count = len(measured.labels)
        center = measured.centers()
        size = measured.high - measured.low
        trust = ((1.0 - measured.roundness) / _SQUARE).clip(0.0, 1.0)
        new = _State(
            measured.labels,
            np.full(count, now_ns),
            np.full(count, now_ns),
            np.ones(count, dtype=np.int64),
            measured.axes.copy(),
            center.copy(),
            np.zeros((count, 3)),
            size.copy(),
            np.zeros(count),
            np.zeros((count, 3)),
        )
        known = np.flatnonzero(rows >= 0)
        gain = np.ones(count)
        if known.size and self._state is not None:
            before = self._state.rows(rows[known])
            dt = np.maximum((now_ns - before.last_ns) / 1e9, 1e-3)
            times = before.times + 1
            gain[known] = np.maximum(_gain(dt), 1.0 / times)
            g = gain[known]
            rate = g**2 / (2.0 - g)
            # Turns first, since they say which side is which.
            up, first, second = (measured.axes[known, n] for n in (2, 0, 1))
            angle = np.arctan2(
                np.einsum("mi,mi->m", before.axes[:, 0], second),
                np.einsum("mi,mi->m", before.axes[:, 0], first),
            )
            angle += before.turn_rate * dt
            quarter = np.rint(angle / (np.pi / 2))
            off = angle - quarter * (np.pi / 2)
            g_turn = g * trust[known]
            turned = angle - g_turn * off
            axis = np.cos(turned)[:, None] * first + np.sin(turned)[:, None] * second
            new.axes[known] = np.stack([axis, cross(up, axis), up], axis=1)
            new.turn_rate[known] = before.turn_rate - rate * trust[known] * off / dt
            swapped = quarter.astype(np.int64) % 2 == 1
            sides = size[known]
            sides[swapped] = sides[swapped][:, [1, 0, 2]]
            predicted = before.center + before.velocity * dt[:, None]
            error = center[known] - predicted
            new.center[known] = predicted + g[:, None] * error
            new.velocity[known] = before.velocity + (rate / dt)[:, None] * error
            grown = sides - before.size
            new.size[known] = before.size + g[:, None] * grown
            squares = np.stack([(error**2).mean(axis=1), (grown**2).mean(axis=1), off**2], axis=1)
            new.spread[known] = before.spread + g[:, None] * (squares - before.spread)
            new.first_ns[known], new.times[known] = before.first_ns, times
        self._state = new if others is None else new.joined(others)
        sigma = np.sqrt(new.spread * (gain / (2.0 - gain))[:, None])
        sigma[:, 2] = np.hypot(sigma[:, 2], _SIGMA_YAW) / np.maximum(trust, 1e-3)
        return new, sigma


def _gain(dt_s: NDArray[np.float64]) -> NDArray[np.float64]:
    return 1.0 - np.exp(-dt_s / TIME_CONSTANT_S)
