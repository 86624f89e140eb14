"""Track objects with an Intel RealSense camera, using pyrealsense2 (pip install pyrealsense2).

python examples/realsense.py

Not yet tested with a camera, only with a stand-in for pyrealsense2.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from nurbseg import RGBDFrame, Segmenter


def frames(rs: Any, width: int = 640, height: int = 480, fps: int = 30) -> Iterator[RGBDFrame]:
    """Yield frames with depth aligned to color; `rs` is the module pyrealsense2."""
    pipeline, config = rs.pipeline(), rs.config()
    config.enable_stream(rs.stream.depth, width, height, rs.format.z16, fps)
    config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, fps)
    profile = pipeline.start(config)
    try:
        metres_per_unit = profile.get_device().first_depth_sensor().get_depth_scale()
        align = rs.align(rs.stream.color)
        while True:
            aligned = align.process(pipeline.wait_for_frames(5000))
            depth, color = aligned.get_depth_frame(), aligned.get_color_frame()
            if not depth or not color:
                continue
            camera = color.profile.as_video_stream_profile().get_intrinsics()
            depth_m = np.asanyarray(depth.get_data()) * metres_per_unit
            image = np.asanyarray(color.get_data())
            stamp_ns = round(1e6 * color.get_timestamp())
            yield RGBDFrame.from_arrays(
                depth_m, image, camera.fx, camera.fy, camera.ppx, camera.ppy, timestamp_ns=stamp_ns
            )
    finally:
        pipeline.stop()


def main(rs: Any) -> None:
    """Print the position of each object, frame by frame."""
    segmenter = Segmenter()
    for frame in frames(rs):
        for each in segmenter.process(frame).objects:
            x, y, z = each.centroid_m
            print(f"{frame.timestamp_ns}: object {each.label} at ({x:.2f}, {y:.2f}, {z:.2f}) m")


if __name__ == "__main__":
    import pyrealsense2  # type: ignore[import-not-found]

    main(pyrealsense2)
