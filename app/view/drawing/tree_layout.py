"""Where the nodes of a tree are drawn: leaves side by side, parents over the middle of their children."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray


def tree_positions(children: Mapping[str, Sequence[str]], root: str) -> dict[str, tuple[float, int]]:
    """Lay a tree out: each leaf has a column of its own, so that no two subtrees stand over each other.

    Parameters
    ----------
    children : mapping of name to names
        The parts of each node, from left to right; a leaf may be left out.
    root : str
        Name of the node at the top.

    Returns
    -------
    dict of name to (x, level)
        Depth first. Leaves are at x = 0, 1, ...; levels count from 0 at the root.
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
    """Scale a layout of `tree_positions` into a box that stays the same from frame to frame.

    Neighbours and levels of small trees are apart by `spacing_max` and `level_max`.

    Returns
    -------
    places : (N, 2) float32
        x and y, centred across the box, which begins at (0, 0), y downwards.
    spacing : float
        Distance of neighbours on a level.
    """
    places = np.array(positions, dtype=np.float32).reshape(-1, 2)
    extent = places.max(axis=0)
    spacing = min(spacing_max, width / (float(extent[0]) + 1.0))
    level = min(level_max, height / (float(extent[1]) + 1.0))
    places[:, 0] = width / 2.0 + (places[:, 0] - extent[0] / 2.0) * spacing
    places[:, 1] = (places[:, 1] + 0.5) * level
    return places, spacing
