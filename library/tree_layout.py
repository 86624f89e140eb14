"""Positions of a tree's nodes: leaves side by side, parents centered above their children."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray


def tree_positions(children: Mapping[str, Sequence[str]], root: str) -> dict[str, tuple[float, int]]:
    """Return x and level of each node, depth first; leaves are at x = 0, 1, ..., the root at level 0.

    `children` holds the parts of each node, from left to right; leaves may be missing.
    """
    level = {root: 0}
    order, waiting = [], [root]
    while waiting:
        name = waiting.pop()
        order.append(name)
        for child in reversed(children.get(name, ())):
            level[child] = level[name] + 1
            waiting.append(child)
    x = {name: float(column) for column, name in enumerate(each for each in order if not children.get(each))}
    for name in reversed(order):
        if parts := children.get(name, ()):
            x[name] = (x[parts[0]] + x[parts[-1]]) / 2.0
    return {name: (x[name], level[name]) for name in order}


def fitted(
    positions: Sequence[tuple[float, int]], width: float, height: float, spacing_max: float, level_max: float
) -> tuple[NDArray[np.float32], float]:
    """Scale a layout of `tree_positions` into a box from (0, 0) to (`width`, `height`), y downward.

    Neighbors and levels are `spacing_max` and `level_max` apart in small trees, less in large ones. Returns
    the positions, (N, 2), centered horizontally, and the distance of neighbors.
    """
    places = np.array(positions, dtype=np.float32).reshape(-1, 2)
    extent = places.max(axis=0)
    spacing = min(spacing_max, width / (float(extent[0]) + 1.0))
    level = min(level_max, height / (float(extent[1]) + 1.0))
    places[:, 0] = width / 2.0 + (places[:, 0] - extent[0] / 2.0) * spacing
    places[:, 1] = (places[:, 1] + 0.5) * level
    return places, spacing
