"""How the camera moved over the support, from where objects are that stand still."""

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
    lift_m = float(np.median(known_m[:, 2] - seen_m[:, 2]))
    known, seen = known_m[:, :2], seen_m[:, :2]
    turn = before[:2, :2]
    shift = np.median(known - seen @ turn.T, axis=0)
    for _ in range(_STEPS):
        off_m = np.linalg.norm(known - seen @ turn.T - shift, axis=1)
        weight = 1.0 / (1.0 + (off_m / _MOVED_M) ** 2) ** 2
        weight /= weight.sum()
        middle_known, middle_seen = weight @ known, weight @ seen
        a, b = seen - middle_seen, known - middle_known
        angle = np.arctan2(weight @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), weight @ (a * b).sum(axis=1))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        shift = middle_known - turn @ middle_seen
    motion = np.eye(4)
    motion[:2, :2], motion[:2, 3] = turn, shift
    motion[2, 3] = lift_m if abs(lift_m - before[2, 3]) > _OTHER_PLANE_M else before[2, 3]
    return motion
