"""Things that fell on a table, on the floor or into a shelf."""

import math

import numpy as np
from physics import settle
from sensor import Camera
from shapes import Solid, box

#: Numbers of what is no object.
SUPPORT, FLOOR, WALL = 1, 2, 3


def tabletop(rng: np.random.Generator) -> tuple[list[tuple[int, Solid]], Camera, bool]:
    """Draw a scene: numbered solids, a camera, and whether only the table and what is on it has depth."""
    place = rng.choice(["wide", "cut", "room", "shelf"], p=[0.4, 0.2, 0.25, 0.15])
    few = rng.random() < 0.4
    count = int(rng.integers(3, 10) if few else rng.integers(10, 28))
    spread = rng.uniform(0.07, 0.13 if few else 0.2) * (1.3 if place == "wide" else 1.0)
    size = (6.0, 6.0) if place == "wide" else rng.uniform((0.9, 0.6), (1.8, 1.0))
    solids = [(SUPPORT, box(*size, 0.03).placed((0.0, 0.0, -0.03)))]
    if place == "shelf":
        height, side = rng.uniform(0.3, 0.5), rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.5)
        solids += [
            (WALL, box(2.0, 0.02, 1.0).placed((0.0, rng.uniform(0.12, 0.22), -0.2))),
            (WALL + 1, box(2.0, size[1] / 2, 0.02).placed((0.0, 0.15, height))),
            (WALL + 2, box(0.02, size[1] / 2, height).placed((side, 0.15, 0.0))),
        ]
        spread, count = 0.1, min(count, 12)
    elif place != "wide":
        away = size[1] / 2 + rng.uniform(0.01, 1.2)
        solids += [
            (FLOOR, box(12.0, 12.0, 0.1).placed((0.0, 0.0, -rng.uniform(0.4, 0.9)))),
            (WALL, box(12.0, 0.1, 5.0).placed((0.0, away, -1.0))),
        ]
        if rng.random() < 0.4:
            beside = rng.choice([-1.0, 1.0]) * (size[0] / 2 + rng.uniform(0.05, 0.8))
            solids.append((WALL + 1, box(0.1, 12.0, 5.0).placed((beside, 0.0, -1.0))))
    spots, last = [], [(0.0, 0.0)]
    for _ in range(count):
        near = last[rng.integers(len(last))] if rng.random() < 0.4 else (0.0, 0.0)
        x, y = np.add(near, rng.normal(0.0, 0.03 if near[0] else spread, 2))
        last.append((x, y))
        spots.append((x, min(y, 0.08) if place == "shelf" else y, 0.0, 1.0))
    fallen = settle(rng, [solid for _, solid in solids], spots)
    solids += [(10 + number, solid) for number, solid in enumerate(fallen)]
    points = np.concatenate([solid.vertices for solid in fallen])
    target = points.mean(axis=0) + rng.normal(0.0, 0.03, 3)
    up = math.radians(rng.uniform(8, 35) if place == "shelf" else rng.uniform(18, 75))
    around = rng.uniform(-0.5, 0.5) if place != "wide" else rng.uniform(0.0, 2 * math.pi)
    way = np.array([math.sin(around) * math.cos(up), -math.cos(around) * math.cos(up), math.sin(up)])
    # As near as all of it fits into the view, or farther.
    for distance in np.linspace(0.8, 1.4, 25):
        seen = Camera.at(target + distance * way, target, 0.0).pixels(points)
        if ((np.abs(seen[:, 0]) < 290) & (np.abs(seen[:, 1]) < 225)).mean() > 0.97:
            break
    distance *= rng.uniform(1.0, 1.15) if rng.random() < 0.7 else rng.uniform(1.15, 1.8)
    return solids, Camera.at(target + distance * way, target, rng.normal(0.0, 0.03)), place == "cut"
