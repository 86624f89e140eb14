"""Furnished rooms: walls, floor and ceiling, furniture along three walls, and things on it."""

import math
from itertools import pairwise

import numpy as np
from physics import Spot, settle
from sensor import Camera
from shapes import Array, Solid, box, joined, lathe, prism, rounded
from tabletops import FLOOR, WALL

#: Numbers of the first object, and of the ceiling.
_FIRST, _CEILING = 10, 8
#: What stands on the floor; what may stand apart from walls; what has things on it; and what hangs on walls.
_STANDING = (
    *("cupboard", "shelf", "table", "table", "bed", "sofa"),
    *("chair", "door", "radiator", "bin", "crates"),
)
_APART, _LADEN = ("table", "chair", "bin", "crates"), ("cupboard", "shelf", "table", "bed")
_HANGING = ("picture", "picture", "curtain", "blind")


def _boxes(*rows: tuple[float, ...]) -> Solid:
    """Return one solid of boxes: sizes, and the middle of the lower edge of the back."""
    return joined(*(box(x, y, z).placed((u, v + y / 2, w)) for x, y, z, u, v, w in rows))


def _legs(x: float, y: float, z: float, thick: float) -> Solid:
    ends = [(a * (x - thick) / 2, b * (y - thick)) for a in (-1, 1) for b in (0, 1)]
    return _boxes(*((thick, thick, z, across, deep, 0.0) for across, deep in ends))


def _cupboard(rng: np.random.Generator) -> list[Solid]:
    """Make a cupboard, a chest of drawers or a refrigerator, with fronts that stand out a little."""
    x, y, z, out = rng.uniform((0.45, 0.35, 0.6, 0.008), (1.4, 0.65, 1.0, 0.03))
    z += rng.choice([0.0, 0.9])
    columns, rows = rng.integers(1, (4, 5))
    wide, high = x / columns, (z - 0.1) / rows
    fronts = [(-x / 2 + (a + 0.5) * wide, y, 0.08 + b * high) for a in range(columns) for b in range(rows)]
    return [
        _boxes(
            (x, y, z, 0.0, 0.0, 0.0),
            *((wide - 0.012, out, high - 0.012, *at) for at in fronts),
            *((0.12, out + 0.03, 0.02, at[0], y, at[2] + 0.7 * high) for at in fronts),
        )
    ]


def _shelf(rng: np.random.Generator) -> list[Solid]:
    """Make a shelf, with a row of books or a box on most boards."""
    x, y, z, thick = *rng.uniform((0.6, 0.22, 0.8), (1.5, 0.4, 2.1)), 0.025
    levels = int(rng.integers(2, 6))
    step = (z - thick) / levels
    rows = [(thick, y, z, side * (x - thick) / 2, 0.0, 0.0) for side in (-1, 1)]
    rows += [(x, y, thick, 0.0, 0.0, k * step) for k in range(levels + 1)]
    # Most have a back.
    rows += [(x, 0.01, z, 0.0, 0.0, 0.0)] if rng.random() < 0.7 else []
    inside = []
    for k in range(levels):
        low, high, left = k * step + thick, step - thick, rng.uniform(0.04, 0.2) - x / 2
        if rng.random() < 0.55:
            count = int(rng.integers(3, 3 + x / 2 / 0.04))
            wide, deep, tall = rng.uniform(
                (0.02, 0.6 * y, 0.6 * high), (0.06, 0.9 * y, 0.95 * high), (count, 3)
            ).T
            at = np.minimum(left + np.cumsum(wide) - wide / 2, x / 2 - 0.05)
            inside.append(_boxes(*zip(wide, deep, tall, at, 0 * at + 0.02, 0 * at + low, strict=True)))
        elif rng.random() < 0.5:
            wide, deep, tall = rng.uniform((0.2 * x, 0.5 * y, 0.4 * high), (0.5 * x, y - 0.02, 0.9 * high))
            inside.append(_boxes((wide, deep, tall, left + wide / 2, 0.02, low)))
    return [_boxes(*rows), *inside]


def _bed(rng: np.random.Generator) -> list[Solid]:
    """Make a bed with its head at the wall, and pillows."""
    x, y, (z, soft, head) = rng.uniform(0.9, 1.7), 2.0, rng.uniform((0.2, 0.18, 0.6), (0.35, 0.3, 1.1))
    mattress = rounded(x, y - 0.05, soft, 0.15, 0.25).placed((0.0, y / 2 + 0.02, z - 0.02))
    pillow = rounded(0.6, 0.38, 0.14, 0.5, 0.9)
    sides = (-x / 4, x / 4) if x > 1.2 else (0.0,)
    return [
        joined(_boxes((x, y, z, 0, 0, 0), (x + 0.04, 0.04, head, 0, 0, 0)), mattress),
        *(pillow.placed((side, 0.3, z + soft - 0.05)) for side in sides),
    ]


def _sofa(rng: np.random.Generator) -> list[Solid]:
    """Make a sofa or an armchair, some with a cushion."""
    x, y, z, arm, back = rng.uniform((0.7, 0.7, 0.35, 0.12, 0.15), (2.0, 0.95, 0.48, 0.22, 0.25))
    side = rounded(arm, y, z + rng.uniform(0.1, 0.22), 0.2, 0.3)
    sofa = joined(
        _boxes((x - arm, y - 0.1, z - 0.08, 0.0, 0.05, 0.0)),
        rounded(x - 2 * arm, y - back, 0.16, 0.15, 0.3).placed((0.0, (y + back) / 2, z - 0.12)),
        rounded(x - 2 * arm + 0.05, back, 0.5, 0.2, 0.35).placed((0.0, back / 2, z - 0.05)),
        *(side.placed((way * (x - arm) / 2, y / 2, 0.0)) for way in (-1, 1)),
    )
    leaning = np.array([[1.0, 0, 0], [0, 0.26, -0.97], [0, 0.97, 0.26]])
    cushion = rounded(0.42, 0.42, 0.14, 0.4, 0.9)
    cushion = cushion.placed((rng.uniform(-0.3, 0.3) * (x - 0.6), back + 0.1, z + 0.25), leaning)
    return [sofa, cushion] if rng.random() < 0.5 else [sofa]


def _made(kind: str, rng: np.random.Generator) -> list[Solid]:
    """Make a piece of furniture with its back at y = 0, and what is in it; it is the first."""
    draw = rng.uniform
    match kind:
        case "cupboard":
            return _cupboard(rng)
        case "shelf":
            return _shelf(rng)
        case "bed":
            return _bed(rng)
        case "sofa":
            return _sofa(rng)
        case "table":
            x, y, z, thick = draw((0.7, 0.5, 0.45, 0.02), (1.7, 0.9, 0.8, 0.06))
            # Some have drawers, some a screen.
            drawers = [(0.4, y - 0.05, z, 0.2 - x / 2, 0.0, 0.0)] if rng.random() < 0.4 else []
            table = joined(_boxes((x, y, thick, 0.0, 0.0, z), *drawers), _legs(x, y, z, thick + 0.01))
            at, wide, top = draw(-0.2, 0.2), draw(0.4, 0.7), z + thick
            screen = [(wide, 0.04, 0.35, at, 0.15, top + 0.1), (0.08, 0.05, 0.15, at, 0.12, top)]
            screen += [(0.25, 0.2, 0.02, at, 0.05, top)]
            return [table, _boxes(*screen)] if rng.random() < 0.5 else [table]
        case "chair":
            x, z, soft, back = draw((0.4, 0.42, 0.03, 0.2), (0.5, 0.5, 0.09, 0.5))
            feet = lathe([(0.28, 0), (0.28, 0.04), (0.03, 0.08), (0.03, z)]).placed((0.0, x / 2, 0.0))
            posts = [(0.04, 0.03, 0.2, side * (x / 2 - 0.03), 0.0, z) for side in (-1, 1)]
            above = _boxes((x, 0.04, back, 0.0, 0.0, z + 0.1), *posts)
            feet = feet if rng.random() < 0.3 else _legs(x, x, z + soft / 2, 0.04)
            return [joined(rounded(x, x, soft, 0.2, 0.3).placed((0.0, x / 2, z)), above, feet)]
        case "door":
            # In a frame, before or behind its front.
            x, z, out = draw((0.75, 1.95, 0.03), (0.95, 2.1, 0.07))
            frame = [(0.08, out, z, side * (x / 2 + 0.04), 0.0, 0.0) for side in (-1, 1)]
            leaf = (x, draw(0.01, out), z, 0.0, 0.0, 0.0)
            return [_boxes(leaf, *frame, (x, out, 0.08, 0, 0, z), (0.12, 0.09, 0.025, x / 2 - 0.1, 0, 1))]
        case "radiator":
            x, z = draw((0.5, 0.4), (1.4, 0.75))
            ribs = [(0.05, 0.12, z, at, 0.03, 0.1) for at in np.arange(-x / 2, x / 2, 0.07)]
            return [_boxes((x, 0.1, z - 0.04, 0.0, 0.03, 0.12), *ribs)]
        case "bin":
            # Or a lamp.
            r, h = draw((0.12, 0.25), (0.2, 0.6))
            outer = [(r * 0.8, 0.0), (r * 0.9, h / 2), (r, h)]
            shade = [(0.015, 1 + h), (r * 1.1, 1.01 + h), (r * 0.7, 1.3 + h)]
            lamp = lathe([(r, 0), (r, 0.03), (0.015, 0.04), *shade])
            inner = [(radius - 0.01, max(up, 0.01)) for radius, up in outer]
            return [(lathe(outer, inner) if rng.random() < 0.6 else lamp).placed((0.0, r * 1.1, 0.0))]
        case "crates":
            x, y, z = draw((0.3, 0.25, 0.15), (0.6, 0.45, 0.4))
            return [_boxes((x, y, z, draw(0.0, 0.05), 0.0, k * z)) for k in range(int(rng.integers(1, 4)))]
        case "picture":
            # Or a mirror or a board, in a frame.
            x, z, out, low = draw((0.3, 0.3, 0.015, 1.0), (1.2, 0.9, 0.05, 1.5))
            edges = [(0.03, out + 0.01, z, side * (x / 2 - 0.015), 0.0, low) for side in (-1, 1)]
            return [_boxes((x, out, z, 0.0, 0.0, low), *edges)]
        case "blind":
            return [_boxes((*draw((0.5, 0.03, 1.0), (1.6, 0.1, 1.3)), 0.0, 0.0, 0.9))]
        case _:
            # A curtain, in strips, each of which is convex.
            x, fold, width, high = draw((0.5, 0.01, 0.1, 1.9), (1.6, 0.04, 0.25, 2.2))
            across = np.linspace(-x / 2, x / 2, 80)
            front = np.stack([across, 0.1 + fold * np.sin(2 * math.pi * across / width)], axis=1)
            strips = [prism([(*a[:1], 0.02), (*b[:1], 0.02), b, a], high) for a, b in pairwise(front)]
            return [joined(*strips).placed((0.0, 0.0, 0.05))]


def room(rng: np.random.Generator) -> tuple[list[tuple[int, Solid]], Camera, bool]:
    """Draw a room: numbered solids, a camera, and that not only a table has depth."""
    wide, deep, high = rng.uniform((2.6, 2.8, 2.3), (5.0, 5.0, 2.9))
    walls = [
        (FLOOR, box(wide + 1, deep + 1, 0.1).placed((0.0, deep / 2, -0.1))),
        (WALL, box(wide + 1, 0.1, high).placed((0.0, -0.05, 0.0))),
        (WALL + 1, box(0.1, deep + 1, high).placed((-wide / 2 - 0.05, deep / 2, 0.0))),
        (WALL + 2, box(0.1, deep + 1, high).placed((wide / 2 + 0.05, deep / 2, 0.0))),
        (WALL + 3, box(wide + 1, 0.1, high).placed((0.0, deep + 0.05, 0.0))),
        (_CEILING, box(wide + 1, deep + 1, 0.1).placed((0.0, deep / 2, high))),
    ]
    focus, turn = np.array([rng.uniform(-0.3, 0.3) * wide, 0.0]), rng.uniform(-0.6, 0.6)
    eye = focus + min(rng.uniform(1.6, 3.2), deep - 0.3) * np.array([math.sin(turn), math.cos(turn)])
    eye[0] = np.clip(eye[0], 0.2 - wide / 2, wide / 2 - 0.2)
    objects: list[Solid] = []
    taken: list[Array] = []
    spots: list[Spot] = []
    kinds = [*rng.choice(_STANDING, int(rng.integers(8, 17))), *rng.choice(_HANGING, int(rng.integers(2, 8)))]
    for kind in map(str, kinds):
        found, at = _made(kind, rng), rng.random()
        if kind in _APART and at < 0.5:
            place, angle = (
                (rng.uniform(-0.4, 0.4) * wide, rng.uniform(0.4, 1.5)),
                rng.uniform(-math.pi, math.pi),
            )
        elif at < 0.75:
            place, angle = (rng.uniform(-0.45, 0.45) * wide, 0.0), 0.0
        else:
            side = rng.choice([-1.0, 1.0])
            place, angle = (side * wide / 2, rng.uniform(0.2, 2.5)), side * math.pi / 2
        found = [each.placed((*place, 0.0), angle) for each in found]
        points = np.concatenate([each.vertices for each in found])
        low, top = points.min(axis=0), points.max(axis=0)
        inside = max(-low[0], top[0]) < wide / 2 + 0.01 and top[1] < deep and low[1] > -0.01
        near = np.hypot(*(np.clip(eye, low[:2], top[:2]) - eye)) < 0.7
        if not inside or near or any((low < b).all() and (a < top).all() for a, b in taken):
            continue
        taken.append(np.stack([low, top]))
        objects += found
        if kind in _LADEN and top[2] < 1.4:
            height, count = found[0].vertices[:, 2].max() - 0.3, int(rng.integers(0, 7))
            over = (low + top)[:2] / 2 + 0.4 * (top - low)[:2] * rng.uniform(-1, 1, (count, 2))
            spots += [(x, y, height, rng.uniform(0.8, 1.5)) for x, y in over]
    on_floor = rng.uniform((-0.4 * wide, 0.3, 1.0), (0.4 * wide, 1.8, 2.5), (int(rng.integers(0, 5)), 3))
    spots += [(x, y, 0.0, scale) for x, y, scale in on_floor]
    objects += settle(rng, [walls[0][1], *objects], spots)
    solids = [*walls, *((_FIRST + number, solid) for number, solid in enumerate(objects))]
    up, aim = rng.uniform((0.9, 0.3), (1.8, 1.3))
    return solids, Camera.at((*eye, up), (*focus, aim), rng.normal(0.0, 0.03)), False
