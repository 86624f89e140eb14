"""Write the objects of every frame of a ROS 2 bag (MCAP) as label images.

python examples/ros2_bag.py my_bag labels

`nurbseg-live --replay my_bag --speed 0 --export labels` writes these images and more.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2

from nurbseg import Segmenter, open_source


def main(bag: str, folder: str) -> None:
    """Track the objects through the bag; each image is named after the stamp of its depth image."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    segmenter = Segmenter()
    with open_source(bag) as source:
        for frame in source:
            result = segmenter.process(frame)
            cv2.imwrite(f"{folder}/{frame.timestamp_ns}.png", result.labels("objects"))
            print(frame.timestamp_ns, *(f"{event.kind} {event.identity}" for event in result.events))


if __name__ == "__main__":
    main(*sys.argv[1:])
