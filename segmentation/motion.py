"""Where a frame's pixels were in the frame before: labels carried along the motion of the image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def brightness(color: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Return the gray image on every `step`-th row and column, each the mean around it, (h, w) uint8."""
    height, width = (-(-extent // step) for extent in color.shape[:2])
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def resized(image: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return a gray image at another size, (rows, columns)."""
    if image.shape == shape:
        return image
    found = cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(found, dtype=np.uint8)


def flow_back(now: NDArray[np.uint8], before: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Find by dense inverse search where each pixel was in the frame before.

    Parameters
    ----------
    now, before : (h, w) uint8
        Gray images.

    Returns
    -------
    (h, w, 2) float32
        Columns and rows from a pixel of this frame to its place in the one before; 0 where the images are
        too small to tell.

    References
    ----------
    .. [1] T. Kroeger et al., "Fast optical flow using dense inverse search", ECCV 2016.
    """
    if min(now.shape) < 32:
        return np.zeros((*now.shape, 2), dtype=np.float32)
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    found = search.calc(now, before, np.zeros((*now.shape, 2), dtype=np.float32))
    return np.asarray(found, dtype=np.float32)


def carried(image: NDArray[np.uint16], flow: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Carry the values of the frame before to where they are now.

    Parameters
    ----------
    image : (H, W) uint16
        Of the frame before.
    flow : (h, w, 2) float32
        As of `flow_back`, on an image of this size or smaller.

    Returns
    -------
    (H, W) uint16
        The value that each pixel had, the nearest one; 0 for what comes into view.
    """
    height, width = image.shape
    h, w = flow.shape[:2]
    if (h, w) != (height, width):
        flow = cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR).astype(np.float32)
        flow = flow * np.array([width / w, height / h], dtype=np.float32)
    columns = np.arange(width, dtype=np.float32) + flow[..., 0]
    rows = np.arange(height, dtype=np.float32)[:, np.newaxis] + flow[..., 1]
    found = cv2.remap(image, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(found, dtype=np.uint16)


__all__ = ["brightness", "carried", "flow_back", "resized"]
