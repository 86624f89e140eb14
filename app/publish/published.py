"""What streams hold of a result: its objects as JSON, and their points."""

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.export.objects import objects_document
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.live.identity import event_text

#: Points of a frame, at most.
_POINTS_MAX = 40_000
#: Position in meters, color, and label of the object.
POINT = np.dtype([("xyz", "<f4", 3), ("bgra", "u1", 4), ("label", "<u2"), ("", "V2")])


def published_document(result: FrameResult) -> dict[str, Any]:
    """Return the objects of a frame with its age, latencies and events, as JSON has them.

    The age is that at the call: seconds since the frame arrived at this computer; null in a replay.
    """
    arrived_s = result.frame.arrived_s
    return objects_document(result) | {
        "age_s": None if arrived_s is None else round(time.monotonic() - arrived_s, 4),
        "latency_ms": {stage: round(ms, 2) for stage, ms in result.elapsed_ms.items()},
        "lost": [{"object": each.label, "lost_s": round(each.lost_s, 3)} for each in result.lost_objects],
        "events": [event_text(event) for event in result.events],
    }


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
