"""Light in the synthetic scene: what a lamp and the sky make of the paint."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.synthetic_scene import Scene, SceneObject
from nurbseg.drivers.synthetic_shapes import Components, Rectangle

#: Direction to the lamp, from left, in front and above.
_LAMP = np.array([-0.45, -0.5, 0.95]) / np.linalg.norm([-0.45, -0.5, 0.95])
_LAMP_COLOR = np.array([1.06, 1.0, 0.92], dtype=np.float32)
_SKY_COLOR = np.array([0.93, 0.98, 1.08], dtype=np.float32)
_LAMP_SHARE, _SKY_SHARE = 0.66, 0.52
#: Directions to the parts of the lamp, whose breadth softens the shadows.
_LAMP_PARTS = 14
_SHADOW_SIZE = (112, 176)


def shaded(
    each: SceneObject, pose: NDArray[np.float64], point: Components, face: NDArray[np.uint8], eye: Components
) -> NDArray[np.uint8]:
    """Return the color of points on an object: paint, lamp, sky and a highlight."""
    normal, s, t = each.shape.surface(point, face)
    rotation = pose[:3, :3].astype(np.float32)
    lamp = (rotation.T @ _LAMP).astype(np.float32)
    up = rotation[2]
    facing = np.clip(normal[0] * lamp[0] + normal[1] * lamp[1] + normal[2] * lamp[2], 0, 1)
    upward = normal[0] * up[0] + normal[1] * up[1] + normal[2] * up[2]
    # Near the table less of the sky is seen.
    height = up[0] * point[0] + up[1] * point[1] + up[2] * point[2] + np.float32(pose[2, 3])
    open_sky = 0.55 + 0.45 * np.clip(height / np.float32(0.05), 0, 1)
    sky = _SKY_SHARE * (0.75 + 0.25 * upward) * open_sky
    light = np.stack([sky * _SKY_COLOR[c] + _LAMP_SHARE * facing * _LAMP_COLOR[c] for c in range(3)], axis=-1)
    painted: Any = _sampled(each.texture, s, t) * light
    if each.shininess:
        view = [eye[i] - point[i] for i in range(3)]
        length = np.sqrt(view[0] ** 2 + view[1] ** 2 + view[2] ** 2)
        half = [view[i] / length + lamp[i] for i in range(3)]
        length = np.sqrt(half[0] ** 2 + half[1] ** 2 + half[2] ** 2)
        glance = np.clip((normal[0] * half[0] + normal[1] * half[1] + normal[2] * half[2]) / length, 0, 1)
        for _ in range(5):
            glance = glance * glance
        painted += (190 * each.shininess * glance * (facing > 0))[..., None]
    return _to_bytes(painted)


def _sampled(texture: NDArray[np.uint8], s: Any, t: Any) -> NDArray[np.uint8]:
    shape = np.broadcast_shapes(np.shape(s), np.shape(t))
    columns = np.broadcast_to(np.asarray(s * (texture.shape[1] - 1), dtype=np.float32), shape)
    rows = np.broadcast_to(np.asarray(t * (texture.shape[0] - 1), dtype=np.float32), shape)
    return np.asarray(
        cv2.remap(texture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8
    )


def _to_bytes(image: Any) -> NDArray[np.uint8]:
    return np.asarray(np.clip(image, 0, 255), dtype=np.uint8)


class Grounds:
    """The scene's flat grounds under the lamp, with the shadows of what stands there.

    What stands still is baked into the paint; the ball's shadow moves over it.
    """

    def __init__(self, scene: Scene) -> None:
        self._paint: dict[int, NDArray[np.uint8]] = {}
        still = [n for n, each in enumerate(scene.objects) if not isinstance(each.shape, Rectangle)]
        still.remove(scene.ball)
        for number, each in enumerate(scene.objects):
            if not isinstance(each.shape, Rectangle):
                continue
            pose = each.world_from_object
            low, high = each.shape.corners_m.min(axis=0), each.shape.corners_m.max(axis=0)
            grid = np.meshgrid(
                np.linspace(low[0], high[0], _SHADOW_SIZE[1]), np.linspace(high[1], low[1], _SHADOW_SIZE[0])
            )
            lit = _lamp_share(scene, still, pose, grid)
            facing = max(float(pose[:3, 2] @ _LAMP), 0.0)
            height, width = each.texture.shape[:2]
            soft = cv2.resize(lit, (width, height), interpolation=cv2.INTER_LINEAR)
            lit = np.asarray(soft, dtype=np.float32)
            # Under and beside things the sky is shut out too: a broad, weak copy of their shadows.
            open_sky = 0.72 + 0.28 * cv2.GaussianBlur(lit, (0, 0), width / 45)
            light = (
                _SKY_SHARE * open_sky[..., None] * _SKY_COLOR
                + _LAMP_SHARE * facing * lit[..., None] * _LAMP_COLOR
            )
            self._paint[number] = _to_bytes(each.texture * light)

    def painted(
        self, number: int, each: SceneObject, point: Components, ball: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        """Return the color of points on a flat ground."""
        _, s, t = each.shape.surface(point, np.uint8(0))
        painted = _sampled(self._paint[number], s, t)
        # The ball's shadow: how far the line to the lamp passes by its centre, in radii.
        center = np.linalg.inv(each.world_from_object) @ ball[:, 3]
        lamp = each.world_from_object[:3, :3].T @ _LAMP
        offset = [np.float32(center[i]) - point[i] for i in range(3)]
        return painted if abs(center[2]) > 0.3 else _under_ball(painted, offset, lamp, float(ball[2, 3]))


def _under_ball(
    painted: NDArray[np.uint8], offset: list[Any], lamp: NDArray[np.float64], radius_m: float
) -> NDArray[np.uint8]:
    # Every eighth pixel tells where the shadow can be.
    x, y, z = (np.broadcast_to(each, painted.shape[:2]) for each in offset)
    near = np.abs(x[::8, ::8]) + np.abs(y[::8, ::8]) < 9 * radius_m
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    if not rows.size:
        return painted
    part = tuple(slice(max(8 * (n[0] - 1), 0), 8 * (n[-1] + 2)) for n in (rows, columns))
    x, y, z = x[part], y[part], z[part]
    along = x * np.float32(lamp[0]) + y * np.float32(lamp[1]) + z * np.float32(lamp[2])
    beside = np.sqrt(np.maximum(x * x + y * y + z * z - along * along, 0)) / np.float32(radius_m)
    softness = 0.12 + 0.12 * np.maximum(along, 0) / np.float32(radius_m)
    lit = np.clip((beside - 1) / (2 * softness) + 0.5, 0, 1)
    lit = 0.45 + 0.55 * lit * lit * (3 - 2 * lit)
    below = np.clip(np.hypot(x, y) / np.float32(1.3 * radius_m), 0, 1)
    painted[part] = (painted[part] * (lit * (0.7 + 0.3 * below))[..., None]).astype(np.uint8)
    return painted


@lru_cache(maxsize=2)
def grounds_of(seed: int) -> Grounds:
    """Return the lit grounds of the scene of a seed, which take a moment to compute."""
    return Grounds(Scene(seed))


def _lamp_share(
    scene: Scene, casting: list[int], world_from_ground: NDArray[np.float64], grid: Any
) -> NDArray[np.float32]:
    """Return which share of the lamp each point of a flat ground sees."""
    points = np.stack([*grid, np.zeros_like(grid[0]), np.ones_like(grid[0])]).reshape(4, -1)
    world = world_from_ground @ points
    sideways = np.cross(_LAMP, [0.0, 1.0, 0.0])
    sideways /= np.linalg.norm(sideways)
    other = np.cross(_LAMP, sideways)
    lit = np.zeros(points.shape[1], dtype=np.float32)
    for part in range(_LAMP_PARTS):
        # A sunflower's seeds fill the lamp's disc evenly.
        radius, angle = 0.085 * np.sqrt((part + 0.5) / _LAMP_PARTS), part * np.pi * (3 - np.sqrt(5))
        towards = _LAMP + radius * (np.cos(angle) * sideways + np.sin(angle) * other)
        free = np.ones(points.shape[1], dtype=np.bool_)
        for number in casting:
            each = scene.objects[number]
            inverse = np.linalg.inv(each.world_from_object)
            origin = (inverse @ world)[:3].astype(np.float32)
            direction = (inverse[:3, :3] @ towards).astype(np.float32)
            # Rays that pass the object at a distance need no test.
            center = each.shape.corners_m.mean(axis=0)
            reach = float(np.linalg.norm(each.shape.corners_m - center, axis=1).max())
            gap = np.cross((origin.T - center), direction / np.linalg.norm(direction))
            close = np.flatnonzero((gap**2).sum(axis=1) < reach**2)
            if close.size:
                x, y, z = (origin[i, close] for i in range(3))
                t, _ = each.shape.hit((x, y, z), (direction[0], direction[1], direction[2]))
                free[close] &= ~np.isfinite(t)
        lit += free
    return np.asarray((lit / _LAMP_PARTS).reshape(grid[0].shape), dtype=np.float32)
