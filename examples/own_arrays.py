"""Segment a color image and a depth image that another library reads: here OpenCV.

python examples/own_arrays.py color.png depth.png 525 525 319.5 239.5 labels.png
"""

from __future__ import annotations

import sys

import cv2

from nurbseg import RGBDFrame, segment


def main(color_file: str, depth_file: str, fx: str, fy: str, cx: str, cy: str, labels_file: str) -> None:
    """Write the labels of the objects, and print the position and size of each."""
    color = cv2.imread(color_file, cv2.IMREAD_COLOR)
    depth_mm = cv2.imread(depth_file, cv2.IMREAD_UNCHANGED)
    if color is None or depth_mm is None:
        raise SystemExit(f"{color_file}, {depth_file}: cannot be read")
    # OpenCV images are BGR.
    frame = RGBDFrame.from_arrays(depth_mm, color[..., ::-1], float(fx), float(fy), float(cx), float(cy))
    result = segment(frame)
    cv2.imwrite(labels_file, result.labels("objects"))
    for each in result.objects:
        x, y, z = each.centroid_m
        sides = " x ".join(f"{100 * side:.0f}" for side in each.box.size_m)
        print(f"object {each.label}: {each.pixels.size} px at ({x:.2f}, {y:.2f}, {z:.2f}) m, {sides} cm")


if __name__ == "__main__":
    main(*sys.argv[1:])
