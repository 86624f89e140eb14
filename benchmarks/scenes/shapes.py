"""Things of a household as meshes: rings of points with a skin over them, and convex parts for physics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solid:
    """A mesh in meters, and the corners of the convex parts that stand for it when it falls."""

    vertices: Array
    faces: NDArray[np.intp]
    parts: tuple[Array, ...]

    def placed(self, shift: ArrayLike = (0.0, 0.0, 0.0), turn: ArrayLike | float = 0.0) -> Solid:
        """Turn it, by a matrix or an angle about the vertical, then shift it."""
        c, s = math.cos(turn) if np.isscalar(turn) else 0.0, math.sin(turn) if np.isscalar(turn) else 0.0
        matrix = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) if np.isscalar(turn) else np.asarray(turn)
        moved = [points @ matrix.T + np.asarray(shift) for points in (self.vertices, *self.parts)]
        return Solid(moved[0], self.faces, tuple(moved[1:]))


def joined(*solids: Solid) -> Solid:
    """Return one solid of several."""
    starts = np.cumsum([0, *(len(each.vertices) for each in solids)])
    return Solid(
        np.concatenate([each.vertices for each in solids]),
        np.concatenate([each.faces + start for each, start in zip(solids, starts, strict=False)]),
        tuple(part for each in solids for part in each.parts),
    )


def skin(rings: Array, parts: Sequence[Array] | None = None) -> Solid:
    """Stretch a skin over (K, n, 3) rings and close both ends; parts are between rings, if not given."""
    count, around = rings.shape[:2]
    here = np.arange(count * around).reshape(count, around)
    beside = np.roll(here, -1, axis=1)
    sides = np.stack([here[:-1], beside[:-1], beside[1:], here[1:]], axis=-1).reshape(-1, 4)
    ends = [
        np.stack([np.full(around, count * around + end), here[-end], beside[-end]], axis=-1) for end in (0, 1)
    ]
    faces = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]], *ends])
    vertices = np.concatenate([rings.reshape(-1, 3), rings[0].mean(0)[None], rings[-1].mean(0)[None]])
    coarse = rings[:, :: max(1, around // 16)]
    if parts is None:
        parts = _between(coarse)
    return Solid(vertices, faces, tuple(parts))


def _between(rings: Array) -> list[Array]:
    """Return the corners of each ring and the next."""
    return list(np.concatenate([rings[:-1], rings[1:]], axis=1))


def box(x: float, y: float, z: float) -> Solid:
    """Return a box that stands on the origin, by its sizes."""
    return prism([(-x / 2, -y / 2), (x / 2, -y / 2), (x / 2, y / 2), (-x / 2, y / 2)], z)


def prism(outline: ArrayLike, height: float) -> Solid:
    """Return a prism over a convex outline, (n, 2)."""
    flat = np.pad(np.asarray(outline, dtype=np.float64), ((0, 0), (0, 1)))
    return skin(np.stack([flat, flat + np.array([0.0, 0.0, height])]))


def lathe(profile: ArrayLike, inner: ArrayLike | None = None, around: int = 48) -> Solid:
    """Turn a profile of radii and heights, from the bottom up; `inner` is that of a hollow."""
    circle = np.linspace(0.0, 2 * math.pi, around, endpoint=False)

    def turned(line: ArrayLike) -> Array:
        radii, heights = np.asarray(line, dtype=np.float64).T[:, :, None]
        return np.stack(np.broadcast_arrays(radii * np.cos(circle), radii * np.sin(circle), heights), axis=-1)

    outer = turned(profile)
    if inner is None:
        return skin(outer)
    # Staves, and the bottom.
    hollow, step = turned(inner), around // 12
    parts = [
        np.concatenate(
            [ring[pair, :][:, (first, (first + step) % around)].reshape(-1, 3) for ring in (outer, hollow)]
        )
        for pair in ((0, len(outer) // 2), (len(outer) // 2, -1))
        for first in range(0, around, step)
    ]
    bottom = np.concatenate([outer[0, ::3], hollow[0, ::3]])
    return skin(np.concatenate([outer, hollow[::-1]]), [*parts, bottom])


def tube(path: Array, radii: ArrayLike, around: int = 20) -> Solid:
    """Lay a tube along a path in a plane z = const."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side, up = np.stack([-along[:, 1], along[:, 0], 0 * along[:, 0]], axis=1), np.array([0.0, 0.0, 1.0])
    circle = np.linspace(0.0, 2 * math.pi, around, endpoint=False)[:, None]
    radii = np.broadcast_to(np.asarray(radii, dtype=np.float64), len(path))[:, None, None]
    rings = path[:, None] + radii * (np.cos(circle) * side[:, None] + np.sin(circle) * up)
    every = rings[np.linspace(0, len(path) - 1, 7).astype(np.intp)]
    return skin(rings, _between(every))


def rounded(
    x: float, y: float, z: float, square: float, square_above: float, dents: Array | None = None
) -> Solid:
    """Return a superquadric by its sizes: 0 is a box, 1 an ellipsoid; dents are waves of its radius."""

    def power(value: Array, exponent: float) -> Array:
        return np.sign(value) * np.abs(value) ** exponent

    up = np.linspace(-math.pi / 2, math.pi / 2, 34)[1:-1, None]
    turn = np.linspace(0.0, 2 * math.pi, 48, endpoint=False)
    flat = power(np.cos(up), square_above)
    rings = np.stack(
        np.broadcast_arrays(
            x / 2 * flat * power(np.cos(turn), square),
            y / 2 * flat * power(np.sin(turn), square),
            z / 2 * power(np.sin(up), square_above),
        ),
        axis=-1,
    )
    for size, phase, waves, rows in () if dents is None else dents:
        rings = (
            rings * (1.0 + size * np.cos(up) * np.sin(np.round(waves) * turn + rows * up + phase))[..., None]
        )
    rings = rings - [0.0, 0.0, rings[..., 2].min()]
    return skin(rings, [rings[::4, ::4].reshape(-1, 3)])


#: Cup, mug, pot, bowl and plate: least and greatest radius, height and foot in radii; bend, and handles.
_VESSELS = (
    ((0.03, 1.6, 0.6), (0.05, 3.0, 0.9), 1.0, 0),
    ((0.035, 1.8, 0.85), (0.05, 2.6, 1.0), 1.0, 1),
    ((0.07, 0.8, 0.9), (0.12, 1.4, 1.0), 1.0, 2),
    ((0.06, 0.4, 0.3), (0.14, 0.8, 0.6), 0.45, 0),
    ((0.08, 0.15, 0.4), (0.14, 0.25, 0.7), 1.0, 0),
)


def _vessel(rng: np.random.Generator) -> Solid:
    least, most, bend, handles = _VESSELS[rng.integers(len(_VESSELS))]
    r, height, foot = rng.uniform(least, most)
    t, wall, h = np.linspace(0.0, 1.0, 9), 0.003 + 0.02 * r, r * height
    radii = r * (foot + (1.0 - foot) * t**bend)
    solid = lathe(np.stack([radii, h * t], 1), np.stack([radii - wall, np.maximum(h * t, wall)], 1))
    turn = np.linspace(-math.pi / 2, math.pi / 2, 13)
    for side in range(handles):
        path = np.stack([radii[6] + 0.4 * r * np.cos(turn), 0.3 * h * np.sin(turn), 0 * turn], axis=1)
        handle = tube(path, rng.uniform(0.004, 0.007), 12)
        handle = handle.placed((0.0, 0.0, 0.55 * h), np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
        solid = joined(solid, handle.placed(turn=math.pi * side))
    return solid


#: What falls on tables, and how often.
_KINDS = {
    **{"carton": 6, "packet": 3, "book": 5, "prism": 2, "can": 4, "bottle": 3},
    **{"vessel": 8, "ball": 2, "blob": 4, "bent": 2, "tool": 2},
}


def thing(rng: np.random.Generator) -> tuple[Solid, bool]:
    """Draw a thing, and whether it usually lies as it is made."""
    kind = str(rng.choice(list(_KINDS), p=np.array(list(_KINDS.values())) / sum(_KINDS.values())))
    return _made(kind, rng), kind in ("book", "vessel")


def _made(kind: str, rng: np.random.Generator) -> Solid:
    """Make a thing of a kind, with sizes as in life."""
    draw = rng.uniform
    match kind:
        case "carton":
            return box(*draw((0.05, 0.05, 0.03), (0.24, 0.18, 0.26)))
        case "packet":
            x, y, z = draw((0.12, 0.03, 1.2), (0.22, 0.09, 1.6))
            return box(x, y, x * z)
        case "book":
            x, y, z = draw((0.11, 1.25, 0.012), (0.22, 1.5, 0.055))
            return box(x, x * y, z)
        case "prism":
            angles = np.linspace(0.0, 2 * math.pi, int(rng.choice([3, 6, 8])), endpoint=False)[:, None]
            corners = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
            return prism(draw(0.025, 0.1, 2) * corners, draw(0.04, 0.2))
        case "can":
            r, h, edge = draw((0.025, 0.05, 0.001), (0.08, 0.22, 0.006))
            return lathe([(r - edge, 0.0), (r, edge), (r, h - edge), (r - edge, h)])
        case "bottle":
            r, h, neck, shoulder = draw((0.026, 0.15, 0.3, 0.55), (0.05, 0.32, 0.5, 0.8))
            up = shoulder + 0.12
            return lathe([(r, 0), (r * 0.9, h * 0.3), (r, h * shoulder), (r * neck, h * up), (r * neck, h)])
        case "vessel":
            return _vessel(rng)
        case "ball":
            size = draw(0.05, 0.15)
            return rounded(size, size * draw(0.85, 1.0), size * draw(0.8, 1.0), 1.0, 1.0)
        case "blob":
            dents = draw((0.0, 0.0, 1.0, -3.0), (0.05, 6.0, 4.0, 3.0), (3, 4))
            return rounded(*draw((0.04, 0.06, 0.02), (0.2, 0.22, 0.14)), *draw(0.2, 1.2, 2), dents)
        case "bent":
            r, bend, length = draw((0.009, 0.7, 0.15), (0.024, 3.5, 0.28))
            t, thick = (
                np.linspace(0.0, bend, 25),
                np.clip(1.08 - np.abs(np.linspace(-1, 1, 25)) ** 4, 0.25, 1),
            )
            path = length / bend * np.stack([np.cos(t), np.sin(t), 0 * t], axis=1)
            return tube(path, r * thick if rng.random() < 0.5 else r)
        case _:
            # A handle with a head across its end, or beside it.
            length, width, head = draw((0.12, 0.02, 0.06), (0.26, 0.04, 0.13))
            beside = rng.choice([0.0, (head - width) / 2])
            return joined(
                box(length, width, width), box(width, head, width * 1.1).placed((length / 2, beside, 0.0))
            )
