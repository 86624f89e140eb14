"""What a line of results holds."""

import time
from typing import Any

from nurbseg.app.export.objects import objects_document
from nurbseg.library.result import FrameResult
from nurbseg.segmentation.live.identity import event_text


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
