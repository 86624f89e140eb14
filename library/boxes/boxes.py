"""Boxes around points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, compiled
from nurbseg.library.boxes.footprints import STRAY_SHARE, footprints

#: Number of points at equal steps that determine a box, of the many of a frame and of one by itself. Of those
#: of a frame, ends of rows are added.
POINTS, _POINTS_ALONE = 200, 2000
#: Noise moves the outermost points outwards. By how many of its deviations the ends of both sides and of the
#: height are moved back, and by what share of the length at most.
INWARD, INWARD_SHARE = (0.7, 0.7, 1.0), 0.1
#: Signs of a box's corners along its axes.
_CORNERS = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, slots=True, eq=False)
class OrientedBox:
    """A box with a position and an orientation.

    Parameters
    ----------
    center_m : (3,) float64
        Metres, in the depth camera's frame.
    axes : (3, 3) float64
        Unit vectors along its edges in rows, right-handed. The last one is the box's height.
    size_m : (3,) float64
        Lengths of the edges along `axes`, meters.
    """

    center_m: NDArray[np.float64]
    axes: NDArray[np.float64]
    size_m: NDArray[np.float64]

    @classmethod
    def around(cls, points_m: NDArray[np.floating], up: NDArray[np.floating] | None = None) -> Self:
        """Return a box around points except strays.

        Strays are the outermost 1 % at either end of each axis: depth pixels between an object and what is
        behind it would make the box many times too long.

        Parameters
        ----------
        points_m : (N, 3) float
            At least one; of many, some at equal steps determine the box.
        up : (3,) float, optional
            Unit vector along the box's height; by default the direction in which the points vary least.
            At a right angle to it, the box is the rectangle of least area, and its first side is no shorter
            than the second.
        """
        points = np.asarray(points_m[:: -(-len(points_m) // _POINTS_ALONE)], dtype=np.float64)
        ups = least_variance(points)[np.newaxis] if up is None else np.asarray(up, np.float64)[np.newaxis]
        (axes,), (low,), (high,), _ = box_ends(points, np.array([0, len(points)]), ups)
        return cls((low + high) / 2.0 @ axes, axes, high - low)

    @property
    def corners_m(self) -> NDArray[np.float64]:
        """Its corners, (8, 3) meters."""
        return np.asarray(self.center_m + _CORNERS * self.size_m @ self.axes)

    @property
    def camera_from_box(self) -> NDArray[np.float64]:
        """Transform (4, 4) from the box's frame, with its center as the origin, to the camera's."""
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = self.axes.T, self.center_m
        return transform

    @property
    def quaternion(self) -> NDArray[np.float64]:
        """Its orientation, (4,) x, y, z, w: what turns the camera's axes to its own."""
        turn = self.axes.T
        # The largest of the four is found first, so that nothing is divided by a small number.
        squares = np.array([turn[n, n] - np.trace(turn) + turn[n, n] for n in range(3)] + [np.trace(turn)])
        squares = np.maximum(1.0 + squares, 0.0)
        largest = int(squares.argmax())
        x, y, z = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
        sums = turn + turn.T
        rows = [
            [squares[0], sums[0, 1], sums[0, 2], x],
            [sums[0, 1], squares[1], sums[1, 2], y],
            [sums[0, 2], sums[1, 2], squares[2], z],
            [x, y, z, squares[3]],
        ]
        found = np.array(rows[largest])
        return np.asarray(found / np.linalg.norm(found))


class BoxEnds(NamedTuple):
    """Boxes around M sets of points.

    Parameters
    ----------
    axes : (M, 3, 3) float64
        As `OrientedBox` has them; the first side is no shorter than the second.
    low, high : (M, 3) float64
        The ends of the box along each axis, meters from the camera.
    roundness : (M,) float64
        As `footprints` has it.
    """

    axes: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    roundness: NDArray[np.float64]

    @property
    def centers_m(self) -> NDArray[np.float64]:
        """Their middles, (M, 3) meters."""
        return np.asarray(np.einsum("mi,mij->mj", (self.low + self.high) / 2, self.axes))


def box_ends(
    points_m: NDArray[np.float64],
    bounds: NDArray[np.int64],
    ups: NDArray[np.float64],
    noise: float = 0.0,
) -> BoxEnds:
    """Find boxes around many sets of points.

    Parameters
    ----------
    points_m : (N, 3) float64
        All points, set after set, meters.
    bounds : (M + 1,) int64
        Where each set begins, and the last one ends.
    ups : (M, 3) float64
        Unit vectors along the boxes' heights.
    noise : float
        Standard deviation of the sensor's inverse depth, 1/m, by which the boxes are made smaller.

    Returns
    -------
    BoxEnds
        The boxes, in the order of the sets.
    """
    # At a right angle to the height, and not nearly along the camera's axis if that is.
    zero, (x, y, z) = np.zeros(len(ups)), ups.T
    along_axis = (np.abs(z) > 0.9)[:, np.newaxis]
    across = np.where(along_axis, np.stack([zero, z, -y], axis=1), np.stack([y, -x, zero], axis=1))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    found = footprints(points_m, bounds, np.ascontiguousarray(ups), across)
    turn = found[:, :1]
    first = np.cos(turn) * across + np.sin(turn) * cross(ups, across)
    axes = np.stack([first, cross(ups, first), ups], axis=1)
    low, high = found[:, 1:7:2].copy(), found[:, 2:7:2].copy()
    if noise > 0.0:
        middle = np.add.reduceat(points_m, bounds[:-1], axis=0) / np.diff(bounds)[:, np.newaxis]
        # The deviation along the ray, of which each axis has a part.
        inward = INWARD * np.abs(np.einsum("mij,mj->mi", axes, middle)) * (noise * middle[:, 2:])
        inward = np.minimum(inward, INWARD_SHARE * (high - low))
        # Of a few points, none are strays and none too far out.
        inward[np.diff(bounds) * STRAY_SHARE < 1.0] = 0.0
        low, high = low + inward, high - inward
    swapped = high[:, 1] - low[:, 1] > high[:, 0] - low[:, 0]
    axes[swapped, 0], axes[swapped, 1] = axes[swapped, 1], -axes[swapped, 0]
    # The second side turned by a right angle points against the first.
    low[swapped], high[swapped] = (
        np.stack([low[swapped, 1], -high[swapped, 0], low[swapped, 2]], axis=1),
        np.stack([high[swapped, 1], -low[swapped, 0], high[swapped, 2]], axis=1),
    )
    return BoxEnds(axes, low, high, found[:, 7])


@compiled
def cross(a: F64, b: F64) -> F64:
    """Return the cross products of rows, (M, 3); faster than NumPy's for a few."""
    found = np.empty_like(a)
    for m in range(len(a)):
        found[m, 0] = a[m, 1] * b[m, 2] - a[m, 2] * b[m, 1]
        found[m, 1] = a[m, 2] * b[m, 0] - a[m, 0] * b[m, 2]
        found[m, 2] = a[m, 0] * b[m, 1] - a[m, 1] * b[m, 0]
    return found


def least_variance(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vector along which (N, 3) points vary least, away from the camera."""
    centered = points_m - points_m.mean(axis=0)
    axis = np.linalg.eigh(centered.T @ centered)[1][:, 0]
    return np.asarray(axis if axis[2] >= 0 else -axis)
