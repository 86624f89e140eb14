"""The light of the synthetic scene: a lamp and the sky on textured surfaces."""

import math
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, I64, U8, Bool, compiled, inlined
from scene.scene import RenderedScene
from scene.shapes import RECTANGLE

#: Direction to the lamp, from left, in front and above.
LAMP = np.array([-0.45, -0.5, 0.95]) / np.linalg.norm([-0.45, -0.5, 0.95])
_LAMP_COLOR = np.array([1.06, 1.0, 0.92], dtype=np.float32)
_SKY_COLOR = np.array([0.93, 0.98, 1.08], dtype=np.float32)
_LAMP_SHARE, _SKY_SHARE = np.float32(0.66), np.float32(0.52)
#: Directions to the parts of the lamp, whose breadth softens the shadows.
_LAMP_PARTS = 14
_SHADOW_SIZE = (112, 176)
#: Distance from the ball's center, in its radii, from which on its shadow counts for nothing.
_SHADOW_REACH = np.float32(7)
#: Where there is nothing to see.
_BACKGROUND = (52, 54, 58)
#: Single-precision numbers: a Python number would turn results into double precision.
_ZERO, _HALF, _ONE, _TWO, _THREE = (np.float32(n) for n in (0, 0.5, 1, 2, 3))


@compiled
def shade(
    is_lit: Bool,
    shininess: F32,
    vectors: F32,
    camera_height: Any,
    ball_radius: Any,
    x: F32,
    y: F32,
    z: F32,
    objects: U8,
    runs: I64,
    normals: F32,
    image: U8,
) -> None:
    """Put the scene's textures, as a camera sees them, under the lamp and the sky.

    Parameters
    ----------
    is_lit : (S,) bool
        Which textures have the light baked into them; only the ball's shadow is added to these.
    shininess : (S,) float32
        Strength of each object's highlight, 0 to 1.
    vectors : (3, 3) float32
        Directions to the lamp and up, and the ball's center, in the camera's frame.
    camera_height, ball_radius : float32
        Meters.
    x, y, z : (H, W) float32
        What each pixel shows: x / z, y / z and the depth z, meters.
    objects, runs : (H, W) uint8, (R, 3) int64
        Number of the visible object + 1; row, first column and end of each run of pixels that show one.
    normals : (3, H, W) float32
        In the camera's frame.
    image : (H, W, 3) uint8
        The textures, RGB; shaded in place.
    """
    for row, first, end in runs:
        part = slice(first, end)
        pixels = image[row, part]
        normal = normals[0, row, part], normals[1, row, part], normals[2, row, part]
        shape = x[row, part], y[row, part], z[row, part], *normal
        shown = objects[row, first]
        if shown == 0:
            pixels[:, 0], pixels[:, 1], pixels[:, 2] = _BACKGROUND
        elif is_lit[np.int64(shown) - 1]:
            _shadow_row(shape, vectors[0], vectors[2], ball_radius, pixels)
        else:
            shine = np.float32(190) * shininess[np.int64(shown) - 1]
            _light_row(shape, vectors[0], vectors[1], camera_height, shine, pixels)


@inlined
def _shadow_row(shape: Any, lamp: Any, ball: Any, radius: Any, pixels: Any) -> None:
    """Darken a ground where the ball's shadow falls."""
    x, y, z, nx, ny, nz = shape
    reach = _SHADOW_REACH * radius
    for n in range(z.size):
        bx, by, bz = ball[0] - z[n] * x[n], ball[1] - z[n] * y[n], ball[2] - z[n]
        square = bx * bx + by * by + bz * bz
        if square > reach * reach:
            continue
        above = bx * nx[n] + by * ny[n] + bz * nz[n]
        along = bx * lamp[0] + by * lamp[1] + bz * lamp[2]
        share = _ball_shadow(square, above, along, radius)
        for channel in range(3):
            pixels[n, channel] = np.uint8(np.float32(pixels[n, channel]) * share)


@inlined
def _light_row(shape: Any, lamp: Any, up: Any, camera_height: Any, shine: Any, pixels: Any) -> None:
    x, y, z, nx, ny, nz = shape
    for n in range(z.size):
        px, py, pz = z[n] * x[n], z[n] * y[n], z[n]
        normal = nx[n], ny[n], nz[n]
        # Near the table less of the sky is seen.
        height = up[0] * px + up[1] * py + up[2] * pz + camera_height
        open_sky = np.float32(0.55) + np.float32(0.45) * _clipped(height / np.float32(0.05))
        upward = normal[0] * up[0] + normal[1] * up[1] + normal[2] * up[2]
        sky = _SKY_SHARE * (np.float32(0.75) + np.float32(0.25) * upward) * open_sky
        facing = _clipped(normal[0] * lamp[0] + normal[1] * lamp[1] + normal[2] * lamp[2])
        sun = _LAMP_SHARE * facing
        glance = shine * _highlight(px, py, pz, *normal, lamp) if facing > _ZERO else _ZERO
        for channel in range(3):
            light = sky * _SKY_COLOR[channel] + sun * _LAMP_COLOR[channel]
            color = np.float32(pixels[n, channel]) * light + glance
            pixels[n, channel] = np.uint8(min(color, np.float32(255)))


@inlined
def _ball_shadow(square: Any, above: Any, along: Any, radius: Any) -> Any:
    """Return the share of its light that the ball's shadow leaves to a point of a ground.

    The ball's center is at the squared distance `square`, this far above the ground and along the direction
    to the lamp.
    """
    # How far the line to the lamp passes by its center, in radii.
    beside = math.sqrt(max(square - along * along, _ZERO)) / radius
    softness = np.float32(0.12) + np.float32(0.12) * max(along, _ZERO) / radius
    lit = _clipped((beside - _ONE) / (_TWO * softness) + _HALF)
    lit = np.float32(0.45) + np.float32(0.55) * lit * lit * (_THREE - _TWO * lit)
    below = _clipped(math.sqrt(max(square - above * above, _ZERO)) / (np.float32(1.3) * radius))
    return lit * (np.float32(0.7) + np.float32(0.3) * below)


@inlined
def _highlight(px: Any, py: Any, pz: Any, nx: Any, ny: Any, nz: Any, lamp: Any) -> Any:
    """Return how strongly the lamp is mirrored toward the eye."""
    scale = -_ONE / math.sqrt(px * px + py * py + pz * pz)
    hx, hy, hz = px * scale + lamp[0], py * scale + lamp[1], pz * scale + lamp[2]
    glance = _clipped((nx * hx + ny * hy + nz * hz) / math.sqrt(hx * hx + hy * hy + hz * hz))
    for _ in range(5):
        glance *= glance
    return glance


@inlined
def _clipped(value: Any) -> Any:
    return min(max(value, _ZERO), _ONE)


@lru_cache(maxsize=2)
def lit_grounds(seed: int) -> dict[int, NDArray[np.uint8]]:
    """Return the textures of a scene's table and wall, by object, with the light baked into them.

    They include the shadows of all objects but the ball, whose shadow moves.
    """
    scene = RenderedScene(seed)
    still = [n for n, each in enumerate(scene.objects) if each.shape.kind != RECTANGLE]
    still.remove(scene.ball)
    grounds = {}
    for number, each in enumerate(scene.objects):
        if each.shape.kind != RECTANGLE:
            continue
        pose = each.world_from_object
        low, high = each.shape.corners_m.min(axis=0), each.shape.corners_m.max(axis=0)
        grid = np.meshgrid(
            np.linspace(low[0], high[0], _SHADOW_SIZE[1]), np.linspace(high[1], low[1], _SHADOW_SIZE[0])
        )
        lit = _lit_share(scene, still, pose, grid)
        facing = max(float(pose[:3, 2] @ LAMP), 0.0)
        height, width = each.texture.shape[:2]
        soft = cv2.resize(lit, (width, height), interpolation=cv2.INTER_LINEAR)
        lit = np.asarray(soft, dtype=np.float32)
        # Objects shut out some of the sky around them too: a broad, weak copy of their shadows.
        open_sky = 0.72 + 0.28 * cv2.GaussianBlur(lit, (0, 0), width / 45)
        light = (
            _SKY_SHARE * open_sky[..., None] * _SKY_COLOR
            + _LAMP_SHARE * np.float32(facing) * lit[..., None] * _LAMP_COLOR
        )
        grounds[number] = np.asarray(np.clip(each.texture * light, 0, 255), dtype=np.uint8)
    return grounds


def _lit_share(
    scene: RenderedScene, casting: list[int], world_from_ground: NDArray[np.float64], grid: Any
) -> NDArray[np.float32]:
    """Return which share of the lamp each point of a flat ground sees."""
    points = np.stack([*grid, np.zeros_like(grid[0]), np.ones_like(grid[0])]).reshape(4, -1)
    world = world_from_ground @ points
    sideways = np.cross(LAMP, [0.0, 1.0, 0.0])
    sideways /= np.linalg.norm(sideways)
    other = np.cross(LAMP, sideways)
    lit = np.zeros(points.shape[1], dtype=np.float32)
    for part in range(_LAMP_PARTS):
        # A sunflower's seeds fill the lamp's disc evenly.
        radius, angle = 0.085 * np.sqrt((part + 0.5) / _LAMP_PARTS), part * np.pi * (3 - np.sqrt(5))
        towards = LAMP + radius * (np.cos(angle) * sideways + np.sin(angle) * other)
        free = np.ones(points.shape[1], dtype=np.bool_)
        for number in casting:
            each = scene.objects[number]
            inverse = np.linalg.inv(each.world_from_object)
            origins = (inverse @ world)[:3].T.astype(np.float32)
            direction = (inverse[:3, :3] @ towards).astype(np.float32)
            multiples, _ = each.shape.hit(origins, np.broadcast_to(direction, origins.shape))
            free &= np.isinf(multiples)
        lit += free
    return np.asarray((lit / _LAMP_PARTS).reshape(grid[0].shape), dtype=np.float32)
