"""Track objects with a RealSense camera, always in its newest frame (pip install 'nurbseg[realsense]').

python examples/realsense.py [FRAMES]
"""

from __future__ import annotations

import sys
from itertools import islice
from typing import Literal

from nurbseg import LiveApp, open_source


def main(frames: int | None = None, view: Literal["auto", "none"] = "auto") -> None:
    """Show and print the objects, frame by frame; of so many frames, or until Ctrl-C."""
    with open_source("realsense:") as source, LiveApp(view=view) as app:
        for result in islice(app.results(source), frames):
            for each in result.objects:
                x, y, z = each.box.center_m
                print(f"{result.frame.timestamp_ns}: object {each.label} at ({x:.2f}, {y:.2f}, {z:.2f}) m")
            print(f"{source.missed} frames skipped so far")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else None)
