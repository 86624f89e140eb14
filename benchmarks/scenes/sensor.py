"""A structured-light camera: rays to meshes, and what block matching makes of the pattern that comes back.

Its edges, holes and noise are like those of a Kinect, whose residuals on a flat table are 2.1e-3 1/m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray
from shapes import Array, Solid

WIDTH, HEIGHT, FOCAL = 640, 480, 525.0
#: From the camera to the projector, in m; disparity times depth, in pixels and m; steps per pixel.
_BASELINE, _DISPARITY, _STEPS = 0.075, 43.5, 8.0
#: Pixels of a window of block matching, and the deviation of its weights.
_WINDOW, _WINDOW_PX = 9, 2.4
#: Difference of disparities on one surface; share of a window that is a match, and of one in front.
_SAME, _SHARE, _SHARE_NEAR = 1.1, 0.33, 0.14
#: Least signal: what white shows 1 m in front of the camera is 1. Noise, in pixels of disparity.
_SIGNAL, _NOISE = 0.012, 1.5e-3 * _DISPARITY
#: Depth that is measured, in m, and pixels that are, alone, none.
_NEAR, _FAR, _SPECKLE = 0.45, 6.0, 25


@dataclass(frozen=True)
class Camera:
    """Where it is, and its axes to the right, down and forward as columns."""

    position: Array
    axes: Array

    @staticmethod
    def at(position: ArrayLike, target: ArrayLike, roll: float) -> Camera:
        """Look from one place at another, turned about the view by some radians."""
        where = np.asarray(position, dtype=np.float64)
        forward = np.asarray(target) - where
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        c, s = np.cos(roll), np.sin(roll)
        return Camera(where, np.stack([c * right + s * down, c * down - s * right, forward], axis=1))

    def pixels(self, points: Array) -> Array:
        """Project points: u and v from the center, and depth."""
        seen = (points - self.position) @ self.axes
        return np.concatenate([FOCAL * seen[:, :2] / np.maximum(seen[:, 2:], 0.05), seen[:, 2:]], axis=1)


@dataclass(frozen=True)
class Picture:
    """Depth in millimeters, which solid it shows, numbered from 1, and colors."""

    depth_mm: NDArray[np.uint16]
    solid: NDArray[np.intp]
    color: NDArray[np.uint8]


def photographed(solids: Sequence[Solid], camera: Camera, noise: float, rng: np.random.Generator) -> Picture:
    """Take a picture of solids with some times the noise of a Kinect."""
    scene = EmbreeScene()
    triangles = np.concatenate([each.vertices[each.faces] for each in solids])
    of = np.repeat(np.arange(1, len(solids) + 1), [len(each.faces) for each in solids])
    TriangleMesh(scene, triangles.astype(np.float32))
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)

    u, v = np.meshgrid(np.arange(WIDTH) - (WIDTH - 1) / 2, np.arange(HEIGHT) - (HEIGHT - 1) / 2)
    rays = np.stack([u / FOCAL, v / FOCAL, np.ones_like(u)], axis=-1).reshape(-1, 3) @ camera.axes.T
    found = scene.run(
        np.broadcast_to(camera.position, rays.shape).astype(np.float32), rays.astype(np.float32), output=True
    )
    hit = np.flatnonzero(found["primID"] >= 0)
    triangle, rays = found["primID"][hit], rays[hit]
    depth = np.zeros(u.size)
    depth[hit] = found["tfar"][hit]
    solid = np.zeros(u.size, dtype=np.intp)
    solid[hit] = of[triangle]
    normal = normals[triangle]
    normal *= -np.sign((normal * rays).sum(axis=1, keepdims=True))
    points = camera.position + depth[hit, None] * rays + 3e-4 * normal

    way = camera.position + _BASELINE * camera.axes[:, 0] - points
    length = np.linalg.norm(way, axis=1)
    way /= length[:, None]
    cosine = np.maximum((way * normal).sum(axis=1), 0.0)
    free = scene.run(
        points.astype(np.float32), way.astype(np.float32), dists=length.astype(np.float32), query="OCCLUDED"
    )
    # Infrared reflectance and gray of each solid; the lamp is where the projector is.
    paint = np.append(0.0, 0.25 + 0.7 * rng.beta(2.2, 1.2, len(solids)))
    signal, gray = np.zeros((2, u.size))
    signal[hit] = np.where(free != 0, paint[solid[hit]] * cosine / np.maximum(length, 0.5) ** 2, 0.0)
    gray[hit] = 255.0 * paint[solid[hit]] * cosine
    shape = (HEIGHT, WIDTH)
    depth_mm, source = _matched(depth.reshape(shape), signal.reshape(shape), noise, rng)
    color = np.repeat(gray.astype(np.uint8)[:, None], 3, axis=1).reshape(*shape, 3)
    return Picture(depth_mm, np.where(depth_mm > 0, solid[source], 0), color)


def _waves(rng: np.random.Generator, across: float, down: float) -> Array:
    """Return noise of unit deviation that is correlated over some pixels."""
    # What is smooth over many pixels is made small.
    coarse = max(1, int(min(across, down) / 4))
    size = (-(-HEIGHT // coarse), -(-WIDTH // coarse))
    noise = cv2.GaussianBlur(rng.normal(size=size), (0, 0), sigmaX=across / coarse, sigmaY=down / coarse)
    return np.asarray(cv2.resize(noise / noise.std(), (WIDTH, HEIGHT)))


def _matched(
    depth: Array, signal: Array, noise: float, rng: np.random.Generator
) -> tuple[NDArray[np.uint16], NDArray[np.intp]]:
    """Return depth in mm, and for each pixel the one, as a flat index, whose surface it measures."""
    lit = signal > 0.01
    disparity = np.where(lit, _DISPARITY / np.maximum(depth, 0.1), 0.0)
    square = np.ones((_WINDOW, _WINDOW), dtype=np.uint8)
    slopes = []
    for axis in (0, 1):
        step = np.abs(np.diff(disparity, axis=axis))
        pads = [((0, 1), (0, 0)), ((1, 0), (0, 0))] if axis == 0 else [((0, 0), (0, 1)), ((0, 0), (1, 0))]
        slopes.append(np.minimum(*(np.pad(step, pad, mode="edge") for pad in pads)))
    same = _SAME + np.minimum(3.0 * np.hypot(*slopes), 1.2)
    far = cv2.erode(np.where(lit, disparity, 1e3), square)
    # Edges are ragged.
    edge = (cv2.dilate(disparity, square) - far > same + 1.0) | (cv2.erode(lit.astype(np.uint8), square) == 0)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    shaken = [np.where(edge, at + np.round(1.1 * _waves(rng, 1.6, 0.9)), at).astype(np.intp) for at in (v, u)]
    source = np.clip(shaken[0], 0, HEIGHT - 1) * WIDTH + np.clip(shaken[1], 0, WIDTH - 1)
    disparity, lit, same = (image.ravel()[source] for image in (disparity, lit, same))
    strength = np.where(lit, np.minimum(signal.ravel()[source], 1.2) ** 0.7, 0.0)

    front = lit & (disparity - far > same)
    back = lit & ~front
    sums = {
        (side, name): cv2.GaussianBlur(np.where(mask, value, 0.0), (_WINDOW, _WINDOW), _WINDOW_PX)
        for side, mask in ((True, front), (False, back))
        for name, value in (("share", 1.0), ("strength", strength), ("mean", strength * disparity))
    }
    gain = rng.uniform(2.0, 4.0) * (1.0 + 0.35 * _waves(rng, 2.5, 1.2))
    means = {side: sums[side, "mean"] / np.maximum(sums[side, "strength"], 1e-9) for side in (True, False)}
    # What is in front has the better contrast: it grows over what is behind.
    grows = (
        ~front
        & (means[True] - disparity > same)
        & (gain * sums[True, "strength"] > sums[False, "strength"])
        & (sums[True, "share"] > _SHARE_NEAR)
    )
    taken = front | grows
    share, strong, mean = (
        np.where(taken, sums[True, name], sums[False, name]) for name in ("share", "strength", "mean")
    )
    mean /= np.maximum(strong, 1e-9)
    mean = np.where(lit & ~grows & (np.abs(mean - disparity) > same), disparity, mean)
    for mask, needed in ((front, grows), (back, ~taken & ~lit)):
        _, nearest = cv2.distanceTransformWithLabels(
            (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        place = np.zeros(int(nearest.max()) + 1, dtype=np.intp)
        place[nearest[mask]] = source[mask]
        source = np.where(needed, place[nearest], source)

    valid = share > _SHARE * (1.0 + 0.15 * _waves(rng, 3.5, 2.0))
    valid &= np.log(np.maximum(strong, 1e-6)) > np.log(_SIGNAL) + 0.35 * _waves(rng, 4.0, 2.5)
    off = _waves(rng, 2.6, 1.3) * (0.8 + 0.2 / np.clip(strong, 0.3, 1.0))
    off += rng.uniform(1.1, 1.9) * _waves(rng, 70.0, 55.0) + 0.45 * rng.normal(size=off.shape)
    mean = np.round((mean + noise * _NOISE * off) * _STEPS) / _STEPS
    meters = np.where(valid & (mean > 0), _DISPARITY / np.maximum(mean, 1e-3), 0.0)
    meters[(meters < _NEAR) | (meters > _FAR)] = 0.0
    meters[:, : int(rng.integers(0, 4))] = 0.0
    meters[:, WIDTH - int(rng.integers(8, 40)) :] = 0.0
    _, parts, counted, _ = cv2.connectedComponentsWithStats((meters > 0).astype(np.uint8))
    meters[counted[parts, cv2.CC_STAT_AREA] < _SPECKLE] = 0.0
    return np.round(1000.0 * meters).astype(np.uint16), source
