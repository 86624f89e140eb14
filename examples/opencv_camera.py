"""Track objects with a camera that OpenCV reads through OpenNI2, and show them.

python examples/opencv_camera.py

This needs an OpenCV build with OpenNI2 and GUI support (the usual packages have neither); tested with a
simulated camera only. `nurbseg-live --device any` needs neither.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from nurbseg import RGBDFrame, Segmenter


def frames(camera: Any) -> Iterator[RGBDFrame]:
    """Yield frames of an open `cv2.VideoCapture` until it ends; depth registered to color."""
    camera.set(cv2.CAP_PROP_OPENNI_REGISTRATION, 1)
    focal_px = camera.get(cv2.CAP_OPENNI_DEPTH_GENERATOR + cv2.CAP_PROP_OPENNI_FOCAL_LENGTH)
    while camera.grab():
        has_depth, depth_mm = camera.retrieve(flag=cv2.CAP_OPENNI_DEPTH_MAP)
        has_color, bgr = camera.retrieve(flag=cv2.CAP_OPENNI_BGR_IMAGE)
        if not (has_depth and has_color):
            continue
        height, width = depth_mm.shape
        center = ((width - 1) / 2, (height - 1) / 2)
        yield RGBDFrame.from_arrays(depth_mm, bgr[..., ::-1], focal_px, focal_px, *center)


def main(camera: Any) -> None:
    """Show each object in the color of its label until a key is pressed."""
    segmenter = Segmenter()
    colors = np.random.default_rng(0).integers(60, 255, (65536, 3), dtype=np.uint8)
    colors[0] = 0
    for frame in frames(camera):
        labels = segmenter.process(frame).labels("objects")
        cv2.imshow("objects", cv2.addWeighted(colors[labels], 0.6, frame.color[..., ::-1], 0.4, 0.0))
        if cv2.waitKey(1) >= 0:
            return


if __name__ == "__main__":
    main(cv2.VideoCapture(cv2.CAP_OPENNI2))
