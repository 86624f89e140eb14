"""How the camera moved over the support, from where objects are that stand still."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, compiled

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


@compiled
def _planar_motion(known_m: F64, seen_m: F64, before: F64) -> tuple[float, float, float, float, float]:
    """Return the cosine and sine of the turn, the shift along x and y, and the median change of height."""
    count = len(known_m)
    # The turn of before; the shift that most objects have.
    c, s = before[0, 0], before[1, 0]
    off_x, off_y = np.empty(count), np.empty(count)
    for i in range(count):
        off_x[i] = known_m[i, 0] - c * seen_m[i, 0] + s * seen_m[i, 1]
        off_y[i] = known_m[i, 1] - s * seen_m[i, 0] - c * seen_m[i, 1]
    x, y = np.median(off_x), np.median(off_y)
    weight = np.empty(count)
    for _ in range(_STEPS):
        total = known_x = known_y = seen_x = seen_y = 0.0
        for i in range(count):
            dx = known_m[i, 0] - c * seen_m[i, 0] + s * seen_m[i, 1] - x
            dy = known_m[i, 1] - s * seen_m[i, 0] - c * seen_m[i, 1] - y
            w = weight[i] = 1.0 / (1.0 + (dx * dx + dy * dy) / _MOVED_M**2) ** 2
            total += w
            known_x, known_y = known_x + w * known_m[i, 0], known_y + w * known_m[i, 1]
            seen_x, seen_y = seen_x + w * seen_m[i, 0], seen_y + w * seen_m[i, 1]
        known_x, known_y = known_x / total, known_y / total
        seen_x, seen_y = seen_x / total, seen_y / total
        cross = dot = 0.0
        for i in range(count):
            ax, ay = seen_m[i, 0] - seen_x, seen_m[i, 1] - seen_y
            bx, by = known_m[i, 0] - known_x, known_m[i, 1] - known_y
            cross += weight[i] * (ax * by - ay * bx)
            dot += weight[i] * (ax * bx + ay * by)
        angle = np.arctan2(cross, dot)
        c, s = np.cos(angle), np.sin(angle)
        x, y = known_x - c * seen_x + s * seen_y, known_y - s * seen_x - c * seen_y
    return c, s, x, y, np.median(known_m[:, 2] - seen_m[:, 2])
