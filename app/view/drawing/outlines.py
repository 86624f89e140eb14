"""The outlines of labels in an image, as lines."""

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from nurbseg.segmentation.config import REFERENCE_PIXELS

#: Smaller regions have no outline, pixels of a 640x480 image; and how far a line may be from its border.
_LEAST_PX, _OFF_PX = 30, 0.8
#: Half the width of a line, on the screen.
_HALF_WIDTH = 1.0
_STRIPS = rr.components.LineStrip2DBatch([]).as_arrow_array().type


def outlines(labels: NDArray[np.uint16]) -> rr.LineStrips2D:
    """Return the outlines of regions of one label, in the colors of their labels.

    Parameters
    ----------
    labels : (H, W) uint16
        0 is no label. The largest has no outlines, so that the table or the floor stays clear.

    Returns
    -------
    LineStrips2D
        Each closed. Lines are smooth: no farther than `_OFF_PX` from the border, without its steps.
    """
    found = list(_regions(labels))
    sizes: dict[int, float] = {}
    for label, _, size in found:
        sizes[label] = sizes.get(label, 0.0) + size
    largest = max(sizes, key=lambda label: sizes[label], default=0)
    shown = [(label, line) for label, line, _ in found if label != largest]
    lines = [line for _, line in shown]
    points = rr.components.Position2DBatch(np.concatenate([np.zeros((0, 2), dtype=np.float32), *lines]))
    return rr.LineStrips2D(
        strips(points.as_arrow_array(), [len(line) for line in lines], _STRIPS),
        class_ids=[label for label, _ in shown],
        radii=rr.Radius.ui_points(_HALF_WIDTH),
        show_labels=False,
    )


def strips(points: pa.Array, sizes: Sequence[int] | NDArray[np.integer], kind: pa.DataType) -> Any:
    """Return lines of so many points in Arrow's form, to which Rerun would convert a list one by one."""
    ends = np.cumsum(sizes, dtype=np.int32)
    return pa.ListArray.from_arrays(np.append(np.int32(0), ends), points, type=kind)


def _regions(labels: NDArray[np.uint16]) -> Iterator[tuple[int, NDArray[np.float32], float]]:
    """Yield label, closed outline (N, 2) and area of each region; columns come first."""
    least = _LEAST_PX * labels.size / REFERENCE_PIXELS
    # In this mode OpenCV follows the borders of all labels at once. Holes are outlines of what is in them.
    contours, tree = cv2.findContours(labels.astype(np.int32), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    for contour, (_, _, _, parent) in zip(contours, () if tree is None else tree[0].tolist(), strict=True):
        label, size = int(labels[contour[0, 0, 1], contour[0, 0, 0]]), cv2.contourArea(contour)
        if label and parent < 0 and size >= least:
            line = cv2.approxPolyDP(contour, _OFF_PX, True)[:, 0].astype(np.float32) + np.float32(0.5)
            yield label, np.concatenate([line, line[:1]]), size
