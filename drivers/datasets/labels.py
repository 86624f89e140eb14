"""Label images on the pixels of a depth image."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.errors import FrameFormatError
from nurbseg.common.files import read_file
from nurbseg.common.frame import Calibration
from nurbseg.common.limits import FRAME_BYTES_MAX
from nurbseg.drivers.datasets.images import decode_labels


def read_labels(path: Path, depth_mm: NDArray[np.uint16], calibration: Calibration) -> NDArray[np.uint16]:
    """Return a label image, (H, W), on the pixels of a depth image of this size.

    Raises FrameFormatError if it is unusable, or has neither the depth nor the color image's size.
    """
    content = read_file(path, FRAME_BYTES_MAX, what="image", error=FrameFormatError)
    labels = decode_labels(content, str(path))
    if labels.shape == depth_mm.shape:
        return labels
    if labels.shape == (calibration.color.height, calibration.color.width):
        return _on_depth(labels, depth_mm, calibration)
    expected = f"expected the depth image's size {depth_mm.shape[1]}x{depth_mm.shape[0]}"
    raise FrameFormatError(f"{path}: {expected}, got {labels.shape[1]}x{labels.shape[0]}")


def _on_depth(
    labels: NDArray[np.uint16], depth_mm: NDArray[np.uint16], calibration: Calibration
) -> NDArray[np.uint16]:
    """Return the label of the color pixel that shows each depth pixel's point; 0 where there is none."""
    rays, color = calibration.depth.rays(), calibration.color
    measured = (depth_mm > 0) & np.isfinite(rays).all(axis=-1)
    z = depth_mm[measured, None] * 1e-3
    found = np.zeros(depth_mm.shape, np.uint16)
    if not z.size:
        return found
    points = np.hstack([rays[measured] * z, z]).astype(np.float64)
    step = calibration.color_from_depth
    turn = cv2.Rodrigues(step[:3, :3])[0]
    places = cv2.projectPoints(points, turn, step[:3, 3], color.matrix, color.distortion)[0].reshape(-1, 2)
    columns, rows = np.rint(np.clip(places, -1.0, 1e6)).astype(int).T
    is_inside = (columns >= 0) & (columns < color.width) & (rows >= 0) & (rows < color.height)
    values = np.zeros(len(points), np.uint16)
    values[is_inside] = labels[rows[is_inside], columns[is_inside]]
    found[measured] = values
    return found
