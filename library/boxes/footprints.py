"""Upright boxes around many sets of points at once."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, I64, compiled

#: Share of the points, at either end of each axis, that are left out as strays.
STRAY_SHARE = 0.01
#: What is returned for each box: the turn, the ends of both sides, those of the height, and the areas' ratio.
COLUMNS = 8


def footprints(
    points_m: NDArray[np.float64],
    bounds: NDArray[np.int64],
    up: NDArray[np.float64],
    across: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Find for each set of points the upright box whose footprint has the least area.

    Strays are left out: the outermost 1 % at either end of the height, and of the footprint's principal axes.

    Parameters
    ----------
    points_m : (N, 3) float64
        All points, set after set, meters.
    bounds : (M + 1,) int64
        Where each set begins, and the last one ends.
    up, across : (M, 3) float64
        Of each set, unit vectors: the box's height, and a direction at a right angle to it.

    Returns
    -------
    (M, 8) float64
        The turn of the box's first side from `across` about `up`, radians from 0 to pi / 2; the least and
        largest position along the first side, the second and `up`, meters; and the area of the footprint over
        that of the one turned by 45 degrees: about 1 for what is round, where the turn means nothing, and
        1 / 2 for a square.
    """
    return _footprints(points_m, bounds, up, across, STRAY_SHARE)


@compiled
def _footprints(points_m: F64, bounds: I64, up: F64, across: F64, stray_share: float) -> F64:
    count = len(bounds) - 1
    found = np.zeros((count, COLUMNS))
    for m in range(count):
        start, n = bounds[m], bounds[m + 1] - bounds[m]
        if n == 0:
            continue
        second = np.cross(up[m], across[m])
        x, y, z = np.empty(n), np.empty(n), np.empty(n)
        for i in range(n):
            p = points_m[start + i]
            x[i] = p[0] * across[m, 0] + p[1] * across[m, 1] + p[2] * across[m, 2]
            y[i] = p[0] * second[0] + p[1] * second[1] + p[2] * second[2]
            z[i] = p[0] * up[m, 0] + p[1] * up[m, 1] + p[2] * up[m, 2]
        strays = int(stray_share * n)
        middle_x, middle_y = x.mean(), y.mean()
        x -= middle_x
        y -= middle_y
        turn = 0.5 * np.arctan2(2.0 * (x * y).mean(), (x * x).mean() - (y * y).mean())
        c, s = np.cos(turn), np.sin(turn)
        low, high = inner_ends(z, strays)
        along, beside = c * x + s * y, c * y - s * x
        first, last = inner_ends(along, strays)
        near, far = inner_ends(beside, strays)
        kept = 0
        for i in range(n):
            inside = low <= z[i] <= high and first <= along[i] <= last and near <= beside[i] <= far
            if inside:
                x[kept], y[kept] = x[i], y[i]
                kept += 1
        x, y = _hull(x[: max(kept, 1)], y[: max(kept, 1)])
        turn, area = 0.0, np.inf
        for i in range(len(x)):
            # One side of the rectangle of least area lies on an edge of the hull.
            after = (i + 1) % len(x)
            along_edge = np.arctan2(y[after] - y[i], x[after] - x[i]) % (np.pi / 2)
            tried = _area(x, y, along_edge)
            if tried < area:
                area, turn = tried, along_edge
        ends = _ends(x, y, turn)
        opposite = _area(x, y, turn + np.pi / 4)
        c, s = np.cos(turn), np.sin(turn)
        shift_1, shift_2 = c * middle_x + s * middle_y, c * middle_y - s * middle_x
        found[m, 0] = turn
        found[m, 1], found[m, 2] = ends[0] + shift_1, ends[1] + shift_1
        found[m, 3], found[m, 4] = ends[2] + shift_2, ends[3] + shift_2
        found[m, 5], found[m, 6] = low, high
        found[m, 7] = area / opposite if opposite > 0 else 0.0
    return found


@compiled
def _ends(x: F64, y: F64, turn: float) -> tuple[float, float, float, float]:
    """Return the least and largest position along two axes at right angles."""
    c, s = np.cos(turn), np.sin(turn)
    first, last = np.inf, -np.inf
    near, far = np.inf, -np.inf
    for i in range(len(x)):
        along, beside = c * x[i] + s * y[i], c * y[i] - s * x[i]
        first, last = min(first, along), max(last, along)
        near, far = min(near, beside), max(far, beside)
    return first, last, near, far


@compiled
def inner_ends(values: F64, strays: int) -> tuple[float, float]:
    """Return the least and the largest of values without so many at either end."""
    least, largest = np.full(strays + 1, np.inf), np.full(strays + 1, -np.inf)
    for value in values:
        # Both are kept in order, the one that goes next last.
        place = strays
        if value < least[place]:
            while place > 0 and least[place - 1] > value:
                least[place] = least[place - 1]
                place -= 1
            least[place] = value
        place = strays
        if value > largest[place]:
            while place > 0 and largest[place - 1] < value:
                largest[place] = largest[place - 1]
                place -= 1
            largest[place] = value
    return least[strays], largest[strays]


@compiled
def _area(x: F64, y: F64, turn: float) -> float:
    first, last, near, far = _ends(x, y, turn)
    return (last - first) * (far - near)


@compiled
def _hull(x: F64, y: F64) -> tuple[F64, F64]:
    """Return the corners of the convex hull, by Andrew's monotone chain."""
    order = np.argsort(x)
    chain = np.empty(2 * len(x) + 1, dtype=np.int64)
    size = 0
    for half in range(2):
        least = size + 1 if half else 1
        for n in range(len(x)):
            i = order[len(x) - 1 - n] if half else order[n]
            while size > least:
                a, b = chain[size - 2], chain[size - 1]
                if (x[b] - x[a]) * (y[i] - y[a]) - (y[b] - y[a]) * (x[i] - x[a]) > 0:
                    break
                size -= 1
            chain[size] = i
            size += 1
    chosen = chain[: max(size - 1, 1)]
    return x[chosen], y[chosen]
