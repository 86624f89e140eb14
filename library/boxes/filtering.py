"""Boxes of objects tied to those of earlier frames, and filtered."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.boxes.boxes import BoxEnds, cross

#: Time constant of the filter of centers, sizes and turns, seconds.
TIME_CONSTANT_S = 0.2
#: For how long an object is remembered that is not seen, seconds.
REMEMBERED_S = 2.0
#: The turn of a box counts fully from this difference of its roundness to 1, and not at all at 0.
_SQUARE = 0.25
#: Differences beyond so many usual ones and so much, meters, count as if they were no larger.
_UNLIKELY, _LIKELY_M = 3.0, 0.005
#: Share of the mean square of differences that chance may make steady.
_STEADY = 0.2
#: Error of the turn of a box that is not round, radians; and of the sides of one that is, as a share.
_SIGMA_YAW, _SIGMA_ROUND = 0.024, 0.035


@dataclass(slots=True)
class BoxStates:
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
    #: Mean differences between measured and predicted centers.
    drift: NDArray[np.float64]
    #: Mean squares of the differences between measured and predicted centers, sizes and turns.
    spread: NDArray[np.float64]

    def moved(self, transform: NDArray[np.float64]) -> BoxStates:
        """Return it in another frame, by the (4, 4) rigid transform from this one."""
        turn, shift = transform[:3, :3], transform[:3, 3]
        return replace(
            self,
            axes=self.axes @ turn.T,
            center=self.center @ turn.T + shift,
            velocity=self.velocity @ turn.T,
            drift=self.drift @ turn.T,
        )

    def rows_of(self, labels: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return the row of each label; -1 if it is new."""
        row_of = {label: row for row, label in enumerate(self.labels.tolist())}
        return np.array([row_of.get(label, -1) for label in labels.tolist()])

    def rows(self, chosen: NDArray[np.intp]) -> BoxStates:
        """Return those of some rows."""
        return BoxStates(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def joined(self, other: BoxStates) -> BoxStates:
        """Return these and others, which follow."""
        names = self.__dataclass_fields__
        return BoxStates(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


def filtered(
    before: BoxStates | None, labels: NDArray[np.int64], measured: BoxEnds, now_ns: int
) -> tuple[BoxStates, BoxStates, NDArray[np.float64]]:
    """Filter the boxes of a frame.

    Parameters
    ----------
    before : BoxStates or None
        What is remembered of earlier frames, in the frame of the boxes.
    labels : (M,) int64
        Of the objects.
    measured : BoxEnds
        Their boxes.
    now_ns : int
        Time of the frame, nanoseconds.

    Returns
    -------
    objects, remembered : BoxStates
        The state of the objects, in order; and that of all that is remembered, the same first.
    sigma : (M, 3) float64
        Standard deviations of each coordinate of the centers and of each side, meters, and of the turns,
        radians, as far as they follow from differences between frames.
    """
    count = len(labels)
    center = measured.centers_m
    size = measured.high - measured.low
    trust = ((1.0 - measured.roundness) / _SQUARE).clip(0.0, 1.0)
    new = BoxStates(
        labels,
        first_ns=np.full(count, now_ns),
        last_ns=np.full(count, now_ns),
        times=np.ones(count, dtype=np.int64),
        axes=measured.axes.copy(),
        center=center.copy(),
        velocity=np.zeros((count, 3)),
        size=size.copy(),
        turn_rate=np.zeros(count),
        drift=np.zeros((count, 3)),
        spread=np.zeros((count, 3)),
    )
    # Of centers, and of sides and turns.
    gains = np.ones((count, 3))
    remembered = new
    if before is not None:
        rows = before.rows_of(labels)
        is_other = now_ns - before.last_ns <= REMEMBERED_S * 1e9
        is_other[rows[rows >= 0]] = False
        known = np.flatnonzero(rows >= 0)
        if known.size:
            own = measured.axes[known], center[known], size[known], trust[known]
            gains[known] = _update(new, known, before.rows(rows[known]), own)
        remembered = new.joined(before.rows(np.flatnonzero(is_other)))
    sigma = np.sqrt(new.spread * gains / (2.0 - gains))
    sigma[:, 1] = np.hypot(sigma[:, 1], _SIGMA_ROUND * (1.0 - trust) * new.size.max(axis=1))
    sigma[:, 2] = np.hypot(sigma[:, 2], _SIGMA_YAW) / np.maximum(trust, 1e-3)
    return new, remembered, sigma


def _update(
    new: BoxStates,
    known: NDArray[np.intp],
    before: BoxStates,
    own: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Fill in rows of objects that were seen before, of which axes, center, size and trust are given.

    Returns how much new centers, sides and turns count, (K, 3).
    """
    axes, center, sides, trust = own
    dt = np.maximum((new.last_ns[known] - before.last_ns) / 1e9, 1e-3)
    times = before.times + 1
    g = np.maximum(gain(dt), 1.0 / times)
    # Turns first, since they say which side is which.
    up, first, second = (axes[:, n].copy() for n in (2, 0, 1))
    angle = np.arctan2(
        np.einsum("mi,mi->m", before.axes[:, 0], second), np.einsum("mi,mi->m", before.axes[:, 0], first)
    )
    angle += before.turn_rate * dt
    quarter = np.rint(angle / (np.pi / 2))
    off = angle - quarter * (np.pi / 2)
    turned = angle - g * trust * off
    axis = np.cos(turned)[:, None] * first + np.sin(turned)[:, None] * second
    new.axes[known] = np.stack([axis, cross(up, axis), up], axis=1)
    new.turn_rate[known] = before.turn_rate - _rate(g) * trust * off / dt
    swapped = quarter.astype(np.int64) % 2 == 1
    sides[swapped] = sides[swapped][:, [1, 0, 2]]
    grown = sides - before.size
    predicted = before.center + before.velocity * dt[:, None]
    error = center - predicted
    squares = np.stack([(error**2).mean(axis=1), (grown**2).mean(axis=1), off**2], axis=1)
    # A frame alone that differs much counts little: parts of objects are lost or gained for a moment.
    likely = _UNLIKELY * np.sqrt(before.spread) + _LIKELY_M
    grown *= np.minimum(1.0, likely[:, 1] / np.maximum(np.sqrt(squares[:, 1]), 1e-9))[:, None]
    error *= np.minimum(1.0, likely[:, 0] / np.maximum(np.sqrt(squares[:, 0]), 1e-9))[:, None]
    spread = before.spread + g[:, None] * (squares - before.spread)
    drift = before.drift + g[:, None] * (error - before.drift)
    # What is off in the same way in frame after frame moves otherwise than predicted, and is followed faster:
    # the tracking signal of Trigg and Leach (1967), squared.
    steady = (drift**2).mean(axis=1) / np.maximum(spread[:, 0], 1e-12)
    followed = np.maximum(g, (steady - _STEADY) / (1.0 - _STEADY))
    new.size[known] = before.size + g[:, None] * grown
    new.center[known] = predicted + followed[:, None] * error
    new.velocity[known] = before.velocity + (_rate(followed) / dt)[:, None] * error
    new.spread[known], new.drift[known] = spread, drift
    new.first_ns[known], new.times[known] = before.first_ns, times
    return np.stack([followed, g, g], axis=1)


def gain(dt_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much a measurement counts so many seconds after the one before."""
    return 1.0 - np.exp(-dt_s / TIME_CONSTANT_S)


def _rate(g: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much it counts for a rate of change."""
    return g**2 / (2.0 - g)
