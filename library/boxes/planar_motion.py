"""How the camera moved over the support, from where objects are that stand still."""

import math
from statistics import median

import numpy as np
from numpy.typing import NDArray

#: Objects that are needed, and steps of the estimate, which lets those count less that moved by themselves.
_OBJECTS_MIN, _STEPS = 2, 4
#: A difference that counts a quarter, meters.
_MOVED_M = 0.005
#: A change of height from which on the support is another plane than before, meters.
_OTHER_PLANE_M = 0.03


def world_from_support(
    known_m: NDArray[np.float64], seen_m: NDArray[np.float64], before: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the rigid motion that takes objects as they are seen to where they are known to be.

    Parameters
    ----------
    known_m : (N, 3) float64
        Where objects are in the world, whose z axis is up, meters.
    seen_m : (N, 3) float64
        Where they are seen in the support's frame, whose z axis is the same.
    before : (4, 4) float64
        The motion of the frame before, where there are too few objects.

    Returns
    -------
    (4, 4) float64
        A turn about z and a shift. Objects that moved by themselves hardly count.
    """
    if len(known_m) < _OBJECTS_MIN:
        return before
    c, s, x, y, lift_m = _planar_motion(known_m, seen_m, before)
    motion = np.eye(4)
    motion[:2, :2], motion[:2, 3] = [[c, -s], [s, c]], (x, y)
    motion[2, 3] = lift_m if abs(lift_m - before[2, 3]) > _OTHER_PLANE_M else before[2, 3]
    return motion


def _planar_motion(
    known_m: NDArray[np.float64], seen_m: NDArray[np.float64], before: NDArray[np.float64]
) -> tuple[float, float, float, float, float]:
    """Return the cosine and sine of the turn, the shift along x and y, and the median change of height.

    Numbers one by one: for some ten objects, calls of NumPy take five times as long.
    """
    pairs = [(*known, *seen) for known, seen in zip(known_m.tolist(), seen_m.tolist(), strict=True)]
    # The turn of before; the shift that most objects have.
    c, s = float(before[0, 0]), float(before[1, 0])
    x = median(kx - c * sx + s * sy for kx, _, _, sx, sy, _ in pairs)
    y = median(ky - s * sx - c * sy for _, ky, _, sx, sy, _ in pairs)
    for _ in range(_STEPS):
        total = known_x = known_y = seen_x = seen_y = 0.0
        weights = []
        for kx, ky, _, sx, sy, _ in pairs:
            dx, dy = kx - c * sx + s * sy - x, ky - s * sx - c * sy - y
            w = 1.0 / (1.0 + (dx * dx + dy * dy) / _MOVED_M**2) ** 2
            weights.append(w)
            total += w
            known_x, known_y = known_x + w * kx, known_y + w * ky
            seen_x, seen_y = seen_x + w * sx, seen_y + w * sy
        known_x, known_y = known_x / total, known_y / total
        seen_x, seen_y = seen_x / total, seen_y / total
        cross = dot = 0.0
        for w, (kx, ky, _, sx, sy, _) in zip(weights, pairs, strict=True):
            ax, ay, bx, by = sx - seen_x, sy - seen_y, kx - known_x, ky - known_y
            cross += w * (ax * by - ay * bx)
            dot += w * (ax * bx + ay * by)
        angle = math.atan2(cross, dot)
        c, s = math.cos(angle), math.sin(angle)
        x, y = known_x - c * seen_x + s * seen_y, known_y - s * seen_x - c * seen_y
    return c, s, x, y, median(kz - sz for _, _, kz, _, _, sz in pairs)
