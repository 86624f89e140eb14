"""Boxes around points."""

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

#: Number of points that determine a box.
_POINTS = 2000
#: Share of the points, at either end of each principal axis, that are left out as strays.
_STRAY_SHARE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class OrientedBox:
    """A box that contains the points of an object except strays.

    Its last axis is the direction in which they vary least; perpendicular to it, the box is the rectangle of
    least area around them. Strays are the outermost 1 % at either end of each principal axis:
    depth pixels between an object and what is behind it would make the box many times too long.

    Parameters
    ----------
    center_m : (3,) float64
        Meters, in the depth camera's frame.
    axes : (3, 3) float64
        Unit vectors along its edges in rows, right-handed.
    size_m : (3,) float64
        Lengths of the edges along `axes`, meters; the first is no shorter than the second.
    """

    center_m: NDArray[np.float64]
    axes: NDArray[np.float64]
    size_m: NDArray[np.float64]

    @classmethod
    def around(cls, points_m: NDArray[np.floating]) -> Self:
        """Return the box of points, (N, 3) meters, at least one; of many, that of a random sample."""
        points_m = np.asarray(points_m)
        if len(points_m) > _POINTS:
            points_m = points_m[np.random.default_rng(0).integers(0, len(points_m), _POINTS)]
        points = _without_strays(np.ascontiguousarray(points_m.T, dtype=np.float64))
        mean = points.mean(axis=1)
        points -= mean[:, np.newaxis]
        axes = _principal_axes(points)
        (_, (width, height), degrees) = cv2.minAreaRect((axes[:2] @ points).T.astype(np.float32))
        turn = np.radians(degrees if width >= height else degrees + 90.0)
        along = np.cos(turn) * axes[0] + np.sin(turn) * axes[1]
        across = np.cos(turn) * axes[1] - np.sin(turn) * axes[0]
        axes = np.array([along, np.sign(np.linalg.det(axes)) * across, axes[2]])
        places = axes @ points
        low, high = places.min(axis=1), places.max(axis=1)
        return cls(mean + (low + high) / 2.0 @ axes, axes, high - low)


def _principal_axes(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors in rows, by descending variance of points, (3, N) around 0."""
    return np.asarray(np.linalg.eigh(points_m @ points_m.T)[1].T[::-1])


def _without_strays(points_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Leave out the outermost of points, (3, N), along each of their principal axes."""
    count = points_m.shape[1]
    strays = int(_STRAY_SHARE * count)
    centered = points_m - points_m.mean(axis=1, keepdims=True)
    places = _principal_axes(centered) @ centered
    ordered = np.partition(places, (strays, count - 1 - strays), axis=1)
    low, high = ordered[:, strays, np.newaxis], ordered[:, count - 1 - strays, np.newaxis]
    return points_m.compress(((places >= low) & (places <= high)).all(axis=0), axis=1)
