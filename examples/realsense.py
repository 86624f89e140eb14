"""Track objects with a RealSense camera, always in its newest frame (pip install 'nurbseg[realsense]').

python examples/realsense.py [FRAMES]
"""

from __future__ import annotations

import sys
from itertools import islice

from nurbseg import Segmenter, open_source


def main(frames: int | None = None) -> None:
    """Print the position of each object, frame by frame; of so many frames, or until Ctrl-C."""
    segmenter = Segmenter()
    with open_source("realsense:") as source:
        for frame in islice(source, frames):
            for each in segmenter.process(frame).objects:
                x, y, z = each.centroid_m
                print(f"{frame.timestamp_ns}: object {each.label} at ({x:.2f}, {y:.2f}, {z:.2f}) m")
            print(f"{source.missed} frames skipped so far")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else None)
