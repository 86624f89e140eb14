"""Track objects with a camera that OpenCV reads through OpenNI2, always in its newest frame, and show them.

python examples/opencv_camera.py

This needs an OpenCV build with OpenNI2 (the usual packages have none); tested with a simulated camera only.
`nurbseg-live --device any` needs none.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any, Literal

import cv2

from nurbseg import FramesSource, LiveApp, RGBDFrame


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


def main(camera: Any, view: Literal["auto", "none"] = "auto") -> None:
    """Show the objects in the viewer, and print where they are."""
    coming = frames(camera)
    first = next(coming)
    with FramesSource(first.calibration) as source, LiveApp(view=view) as app:

        def capture() -> None:
            source.put(first)
            for frame in coming:
                source.put(frame)
            source.end()

        # A daemon, so that Ctrl-C ends the program.
        threading.Thread(target=capture, daemon=True).start()
        for result in app.results(source):
            for each in result.objects:
                print(result.frame.index, each.label, each.box.center_m.round(2), each.box.size_m.round(2))


if __name__ == "__main__":
    main(cv2.VideoCapture(cv2.CAP_OPENNI2))
