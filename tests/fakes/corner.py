"""Two planes that meet 2.5 m away, as a Kinect sees them, and a smooth bend in place of a corner."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.points.registration import PointMap

SHAPE = (240, 320)
FOCAL = 262.5
NOISE_PER_M = 2.1e-3
#: Height of the camera above the floor and its distance from the wall, meters; and how far it looks down.
_HEIGHT_M, _AWAY_M, _DOWN = 1.6, 2.5, np.deg2rad(20.0)


def corner(frame: int = 0, radius_m: float = 0.0) -> tuple[PointMap, NDArray[np.bool_]]:
    """A floor before a wall, and where the wall is; with a radius, a part of a cylinder joins them."""
    _, y = _rays()
    down, ahead = y * np.cos(_DOWN) + np.sin(_DOWN), np.cos(_DOWN) - y * np.sin(_DOWN)
    inverse_depth = np.maximum(down / _HEIGHT_M, ahead / _AWAY_M)
    if radius_m > 0.0:
        # The axis is so far from both; rays hit the far side of the cylinder.
        across, along = _HEIGHT_M - radius_m, _AWAY_M - radius_m
        a, b = down**2 + ahead**2, down * across + ahead * along
        root = np.sqrt(np.maximum(b**2 - a * (across**2 + along**2 - radius_m**2), 0.0))
        bent = (b + root) / a
        is_bent = (bent * down > across) & (bent * ahead > along) & (root > 0)
        inverse_depth = np.where(is_bent, 1.0 / bent, inverse_depth)
    return _seen(inverse_depth, frame), ahead / _AWAY_M > down / _HEIGHT_M


def fold(degrees: float, frame: int = 0) -> tuple[PointMap, NDArray[np.bool_]]:
    """Two walls that meet at an angle in the middle of the image, and where the one on the right is."""
    x, _ = _rays()
    slope = np.tan(np.deg2rad(degrees / 2.0))
    return _seen((1.0 + slope * np.abs(x)) / _AWAY_M, frame), x > 0


def _rays() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    return (columns - 159.5) / FOCAL, (rows - 119.5) / FOCAL


def _seen(inverse_depth: NDArray[np.float64], frame: int) -> PointMap:
    """A frame with the noise of its number, most of which is alike in neighbors."""
    rng = np.random.default_rng(frame)
    near = cv2.GaussianBlur(rng.standard_normal(SHAPE), (0, 0), sigmaX=1.3, sigmaY=0.65)
    noise = 0.9 * near / near.std() + 0.45 * rng.standard_normal(SHAPE)
    depth = 1.0 / (inverse_depth + NOISE_PER_M * noise)
    x, y = _rays()
    points_m = np.dstack([x * depth, y * depth, depth]).astype(np.float32)
    pattern = 110 + 40 * np.sin(80 * x) * np.cos(70 * y)
    color = np.repeat(pattern[..., np.newaxis], 3, axis=2).astype(np.uint8)
    return PointMap(points_m, color, np.ones(SHAPE, dtype=np.bool_))
