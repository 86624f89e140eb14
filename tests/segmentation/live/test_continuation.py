"""A live tree is that of a frame alone after a restart, and soon after another scene came."""

import numpy as np
from numpy.typing import NDArray
from rendered import rendered

from nurbseg.drivers.registry import open_source
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.live.tree import LiveTree
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap, register

CONFIG = SegmentationConfig()


def clouds(seed: int, frames: int) -> list[PointMap]:
    """Return frames of a rendered scene; each seed has its own."""
    with open_source(rendered(f"width=320&height=240&frames={frames}&seed={seed}")) as source:
        return [register(frame) for frame in source]


def agreement(one: NDArray[np.uint16], other: NDArray[np.uint16]) -> float:
    """Return the share of pixels in the best overlap of each label, from either side."""
    counts = np.zeros((int(one.max()) + 1, int(other.max()) + 1), dtype=np.int64)
    np.add.at(counts, (one, other), 1)
    return float(min(counts.max(axis=1).sum(), counts.max(axis=0).sum()) / one.size)


def mirrored(cloud: PointMap) -> PointMap:
    """Return the frame of a scene the other way round."""
    points_m = cloud.points_m[:, ::-1] * np.float32([-1, 1, 1])
    color, colored = (np.ascontiguousarray(each[:, ::-1]) for each in (cloud.color, cloud.colored))
    return PointMap(np.ascontiguousarray(points_m), color, colored)


def test_one_frame_after_another_scene_came_objects_are_nearly_those_of_a_frame_alone() -> None:
    live, others = LiveTree(CONFIG), [mirrored(cloud) for cloud in clouds(5, 2)]
    for cloud in (*clouds(0, 4), others[0]):
        live.segment(cloud)
    assert live.report.reset == "new scene"
    # Surfaces of rounded things differ from frame to frame, also from one alone to the next.
    found, alone = live.segment(others[1]), segment(others[1], CONFIG)
    assert live.report.reset == ""
    assert agreement(found.labels("objects"), alone.labels("objects")) > 0.98
