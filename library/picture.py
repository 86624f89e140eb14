"""A frame with its objects outlined and numbered."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.library.objects import MeasuredObject
from nurbseg.library.palette import label_color

#: Width of outlines and of the dark edge of numbers, pixels, and size of numbers.
_OUTLINE_PX, _INK_PX, _FONT_SCALE = 2, 4, 0.55


def outlined(
    color: NDArray[np.uint8],
    labels: NDArray[np.uint16],
    objects: Sequence[MeasuredObject],
) -> NDArray[np.uint8]:
    """Return an image with the outlines and numbers of objects in their colors.

    Parameters
    ----------
    color : (H, W, 3) uint8
        RGB on the depth image's grid.
    labels : (H, W) uint16
        Label of each pixel's object; 0 without depth.
    objects : sequence of MeasuredObject
        The objects; one that is not explained has a question mark beside its number.

    Returns
    -------
    (H, W, 3) uint8
        RGB. Outlines are inside their objects; the largest object has none. Numbers are where an object is
        widest.
    """
    picture = color.copy()
    largest = max(objects, key=lambda each: each.pixels.size, default=None)
    kernel = np.ones((2 * _OUTLINE_PX + 1, 2 * _OUTLINE_PX + 1), dtype=np.uint8)
    for each in objects:
        if each is not largest:
            own = (labels == each.label).astype(np.uint8)
            picture[(own > 0) & (cv2.erode(own, kernel) == 0)] = label_color(each.label)
    for each in objects:
        own = cv2.copyMakeBorder((labels == each.label).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT)
        within = cv2.distanceTransform(own, cv2.DIST_L2, 5)[1:-1, 1:-1]
        row, column = np.unravel_index(within.argmax(), within.shape)
        text = f"{each.label}{'' if each.is_explained else '?'}"
        (across, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _FONT_SCALE, _INK_PX)
        first, last = (
            (_INK_PX, high + _INK_PX),
            (labels.shape[1] - across - _INK_PX, labels.shape[0] - _INK_PX),
        )
        place = np.clip((column - across // 2, row + high // 2), first, last).tolist()
        for width, ink in ((_INK_PX, (0, 0, 0)), (1, (255, 255, 255))):
            cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, _FONT_SCALE, ink, width, cv2.LINE_AA)
    return picture
