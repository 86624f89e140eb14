"""Where the nodes of a tree are drawn: tidy, narrow, parents over the middle of their children."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray


def tidy_positions(children: Mapping[str, Sequence[str]], root: str) -> dict[str, tuple[float, int]]:
    """Lay a tree out so that no two nodes of a level are nearer than 1 and each subtree looks alike anywhere.

    Parameters
    ----------
    children : mapping of name to names
        The parts of each node, from left to right; a leaf may be left out.
    root : str
        Name of the node at the top.

    Returns
    -------
    dict of name to (x, level)
        The leftmost x is 0; levels count from 0 at the root.

    References
    ----------
    .. [1] E. Reingold and J. Tilford, "Tidier drawings of trees", IEEE TSE 7(2), 1981.
    """
    order = [root]
    for name in order:
        order.extend(children.get(name, ()))

    # From the leaves up: push each subtree right until its left outline clears what stands beside it.
    offset: dict[str, float] = {}
    outlines: dict[str, tuple[list[float], list[float]]] = {}
    for name in reversed(order):
        left: list[float] = []
        right: list[float] = []
        places = []
        for child in children.get(name, ()):
            child_left, child_right = outlines.pop(child)
            shift = max((r - c + 1.0 for r, c in zip(right, child_left, strict=False)), default=0.0)
            places.append(shift)
            moved_left = [each + shift for each in child_left]
            moved_right = [each + shift for each in child_right]
            left += moved_left[len(left) :]
            right = moved_right + right[len(moved_right) :]
        middle = (places[0] + places[-1]) / 2.0 if places else 0.0
        for child, place in zip(children.get(name, ()), places, strict=True):
            offset[child] = place - middle
        outlines[name] = (
            [0.0, *(each - middle for each in left)],
            [0.0, *(each - middle for each in right)],
        )

    positions: dict[str, tuple[float, int]] = {root: (0.0, 0)}
    for name in order:
        x, level = positions[name]
        for child in children.get(name, ()):
            positions[child] = (x + offset[child], level + 1)
    first = min(x for x, _ in positions.values())
    return {name: (x - first, level) for name, (x, level) in positions.items()}


def fitted(
    positions: Sequence[tuple[float, int]], width: float, height: float, spacing_max: float, level_max: float
) -> tuple[NDArray[np.float32], float]:
    """Scale a layout into a box that stays the same from frame to frame.

    Parameters
    ----------
    positions : sequence of (x, level)
        As of `tidy_positions`.
    width, height : float
        The box, from (0, 0), y downwards.
    spacing_max, level_max : float
        Largest distance of neighbours and of levels, for small trees.

    Returns
    -------
    places : (N, 2) float32
        x and y, centred across the box.
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
