"""Large smooth surfaces that fill the frame, each one object: what heaps and rooms do not teach merging.

Quadrics and folded sheets are intersected with the rays of a camera, and get the noise of a structured-light
sensor: correlated, and disparity in steps of 1/8 pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Calibration, Intrinsics, RGBDFrame

_SIZES = ((480, 640), (240, 320))
#: Product of baseline and focal length, in m and pixels, and steps per pixel of disparity.
_DISPARITY, _STEPS = 43.5, 8.0
_NOISE_PER_M = 2.1e-3


def smooth_surfaces(count: int, seed: int = 1) -> Iterator[RGBDFrame]:
    """Render frames that a single surface fills, with the label 10 wherever there is depth.

    Parameters
    ----------
    count : int
        Number of frames.
    seed : int
        Of the shapes and the noise: a frame is the same whatever the count.
    """
    for index in range(count):
        rng = np.random.default_rng([seed, index])
        height, width = _SIZES[index % len(_SIZES)]
        focal = 525.0 * width / 640.0
        rays = np.stack(
            np.meshgrid(
                (np.arange(width) - (width - 1) / 2) / focal, (np.arange(height) - (height - 1) / 2) / focal
            ),
            axis=-1,
        )
        seen = np.zeros((height, width), dtype=np.bool_)
        while seen.mean() < 0.5:
            depth = (_sheet if index % 4 == 3 else _quadric)(rays, rng)
            seen = (depth > 0.4) & (depth < 5.0)
        inverse = 1.0 / np.where(seen, depth, 1.0) + _noise(rays.shape[:2], rng)
        disparity = np.round(inverse * _DISPARITY * _STEPS) / _STEPS
        depth_mm = np.where(seen, np.round(1000.0 * _DISPARITY / np.maximum(disparity, 1.0)), 0.0)
        camera = Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        yield RGBDFrame(
            index=index,
            timestamp_ns=index,
            depth_mm=depth_mm.astype(np.uint16),
            color=np.full((height, width, 3), 128, dtype=np.uint8),
            calibration=Calibration(camera, camera, np.eye(4)),
            labels=np.where(seen, 10, 0).astype(np.uint16),
        )


def _quadric(rays: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Intersect with an ellipsoid or a cylinder, seen from outside or from within."""
    directions = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
    within = rng.random() < 0.6
    radii = rng.uniform(0.3, 1.2) * rng.uniform(0.7, 1.3, 3)
    if rng.random() < 0.3:
        radii[2] = np.inf
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    matrix = turn @ np.diag(1.0 / radii**2) @ turn.T
    away = rng.uniform(0.3, 2.2) if within else rng.uniform(1.05, 2.2)
    center = np.array([*rng.normal(0.0, 0.15, 2), 1.0])
    # In radii: a bowl is seen from within, or over its rim, which is not there.
    center *= away / math.sqrt(center @ matrix @ center)
    a = np.einsum("...i,ij,...j", directions, matrix, directions)
    b = directions @ (matrix @ center)
    root = b * b - a * (center @ matrix @ center - 1.0)
    sign = 1.0 if within else -1.0
    # Grazing rays return no pattern.
    least = 10.0 ** rng.uniform(-3.3, -1.3)
    return np.where(root > least * b * b, (b + sign * np.sqrt(np.maximum(root, 0.0))) / a, 0.0)


def _sheet(rays: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Intersect with a tilted sheet that has gentle folds in two directions."""
    distance, slopes = rng.uniform(0.7, 2.0), rng.normal(0.0, 0.3, 2)
    folds = [
        (angle, rng.uniform(0.15, 0.6), turns / distance, rng.uniform(0.0, 2 * math.pi))
        for angle, turns in zip(rng.uniform(0.0, math.pi, 2), rng.uniform(1.5, 8.0, 2), strict=True)
    ]
    depth = np.full(rays.shape[:2], distance)
    for _ in range(60):
        x, y = rays[..., 0] * depth, rays[..., 1] * depth
        found = distance + slopes[0] * x + slopes[1] * y
        for angle, slope, per_m, phase in folds:
            found += slope / per_m * np.sin(per_m * (math.cos(angle) * x + math.sin(angle) * y) + phase)
        depth = 0.5 * (depth + found)
    return depth


def _noise(shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return noise of inverse depth, 1/m, most of which is correlated over few pixels."""
    near = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), sigmaX=2.6, sigmaY=1.3)
    own = rng.normal(size=shape)
    scale = _NOISE_PER_M * rng.uniform(0.1, 1.2)
    return scale * (0.9 * near / near.std() + 0.45 * own)
