"""The points of a frame's objects, as streams send them."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.library.result import FrameResult

#: Points of a frame, at most.
_POINTS_MAX = 40_000
#: Position in meters, color, and label of the object.
POINT = np.dtype([("xyz", "<f4", 3), ("bgra", "u1", 4), ("label", "<u2"), ("", "V2")])


def object_points(result: FrameResult) -> NDArray[np.void]:
    """Return the points of objects, (N,) of `POINT`, those of every other row and column or fewer."""
    labels = result.labels("objects")
    step = max(1, int(np.ceil(np.sqrt(labels.size / _POINTS_MAX))))
    coarse = labels[::step, ::step]
    shown = coarse > 0
    points = np.zeros(np.count_nonzero(shown), dtype=POINT)
    points["xyz"] = result.cloud.points_m[::step, ::step][shown]
    points["bgra"][:, :3] = result.cloud.color[::step, ::step][shown][:, ::-1]
    points["bgra"][:, 3] = 255
    points["label"] = coarse[shown]
    return points
