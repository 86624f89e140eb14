"""A frame with its objects outlined and numbered."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import Intrinsics
from nurbseg.library.objects import MeasuredObject
from nurbseg.library.palette import label_color

#: Width of outlines, pixels, and size of numbers.
_OUTLINE_PX, _FONT_SCALE = 2, 0.55
#: A box's middle is projected as if it were no nearer, meters.
_NEAREST_M = 0.1


def outlined(
    color: NDArray[np.uint8],
    labels: NDArray[np.uint16],
    objects: Sequence[MeasuredObject],
    camera: Intrinsics,
) -> NDArray[np.uint8]:
    """Return an image with the outlines and numbers of objects in their colors.

    Parameters
    ----------
    color : (H, W, 3) uint8
        RGB on the depth image's grid.
    labels : (H, W) uint16
        Label of each pixel's object; 0 without depth.
    objects : sequence of MeasuredObject
        The objects; one that is not sure has a question mark beside its number.
    camera : Intrinsics
        The depth camera.

    Returns
    -------
    (H, W, 3) uint8
        RGB. Outlines are inside their objects; the largest object has none.
    """
    picture = color.copy()
    largest = max(objects, key=lambda each: each.pixels.size, default=None)
    kernel = np.ones((2 * _OUTLINE_PX + 1, 2 * _OUTLINE_PX + 1), dtype=np.uint8)
    for each in objects:
        if each is not largest:
            own = (labels == each.label).astype(np.uint8)
            picture[(own > 0) & (cv2.erode(own, kernel) == 0)] = label_color(each.label)
    for each in objects:
        x, y, z = each.box.center_m.tolist()
        z = max(z, _NEAREST_M)
        place = round(camera.fx * x / z + camera.cx), round(camera.fy * y / z + camera.cy)
        text = f"{each.label}{'' if each.is_sure else '?'}"
        for width, ink in ((4, (0, 0, 0)), (1, (255, 255, 255))):
            cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, _FONT_SCALE, ink, width, cv2.LINE_AA)
    return picture
