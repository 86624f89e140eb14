"""Track objects with a RealSense camera, always in its newest frame (pip install 'nurbseg[realsense]').

python examples/realsense.py [FRAMES]
"""

from __future__ import annotations

import sys
from itertools import islice

import rerun as rr

from nurbseg import Segmenter, open_source, show


def main(frames: int | None = None, *, spawn: bool = True) -> None:
    """Show and print the objects, frame by frame; of so many frames, or until Ctrl-C."""
    rr.init("objects", spawn=spawn)
    segmenter = Segmenter(target_hz=30.0)
    with open_source("realsense:") as source:
        for frame in islice(source, frames):
            result = segmenter.process(frame)
            show(result)
            for each in result.objects:
                x, y, z = each.box.center_m
                print(f"{frame.timestamp_ns}: object {each.label} at ({x:.2f}, {y:.2f}, {z:.2f}) m")
            print(f"{source.missed} frames skipped so far")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else None)
