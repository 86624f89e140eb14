"""The images of a simulated RealSense: each tells its number."""

from __future__ import annotations

import numpy as np

from nurbseg.common.frame import Calibration, Intrinsics


def images(
    number: int, mode: tuple[int, int, int], kind: str, *, skew_ms: float = 0.0
) -> tuple[np.ndarray, float]:
    """Return an image and its time, milliseconds; color is `skew_ms` later."""
    width, height, fps = mode
    rows, columns = np.mgrid[:height, :width]
    time_ms = 1000.0 * number / fps
    if kind == "depth":
        depth = 1000 + (columns + 2 * rows + 16 * number) % 3000
        depth[:2] = number
        return depth.astype(np.uint16), time_ms
    color = np.stack([columns % 256, rows % 256, np.full_like(rows, number % 256)], axis=-1)
    return color.astype(np.uint8), time_ms + skew_ms


def calibration_of(depth: tuple[int, int, int], color: tuple[int, int, int]) -> Calibration:
    """Cameras beside each other, as the real one's."""
    transform = np.eye(4)
    angle = 0.01
    transform[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    transform[:3, 3] = [0.0147, 0.0002, 0.0003]
    cameras = [
        Intrinsics(width, height, 0.66 * width, 0.66 * width, width / 2 - 1.5, height / 2 + 2.5, distortion)
        for (width, height, _), distortion in (
            (depth, np.zeros(0)),
            (color, np.array([-0.05, 0.06, -0.0007, 0.0005, -0.02])),
        )
    ]
    return Calibration(*cameras, transform)
