"""Labels warped by optical flow from the frame before."""

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, U16, compiled


def brightness(color: NDArray[np.uint8], step: int) -> NDArray[np.uint8]:
    """Return the gray image on every `step`-th row and column, each the mean around it, (h, w) uint8."""
    height, width = (-(-extent // step) for extent in color.shape[:2])
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def flow_back(now: NDArray[np.uint8], before: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Find by dense inverse search where each pixel was in the frame before.

    Parameters
    ----------
    now, before : (h, w) uint8
        Gray images; the one before may be of another size.

    Returns
    -------
    (h, w, 2) float32
        Columns and rows from a pixel of this frame to its position in the one before; 0 if the images are too
        small.

    References
    ----------
    .. [1] T. Kroeger et al., "Fast optical flow using dense inverse search", ECCV 2016.
    """
    if min(now.shape) < 32:
        return np.zeros((*now.shape, 2), dtype=np.float32)
    if before.shape != now.shape:
        before = np.asarray(cv2.resize(before, now.shape[::-1], interpolation=cv2.INTER_AREA), dtype=np.uint8)
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    found = search.calc(now, before, np.zeros((*now.shape, 2), dtype=np.float32))
    return np.asarray(found, dtype=np.float32)


def warped(image: NDArray[np.uint16], flow: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Warp the values of the frame before to this frame.

    Parameters
    ----------
    image : (H, W) uint16
        Of the frame before.
    flow : (h, w, 2) float32
        As of `flow_back`, on an image of this size or smaller.

    Returns
    -------
    (H, W) uint16
        The nearest value at each pixel's position; 0 for what comes into view.
    """
    return _warped(image, flow)


@compiled
def _warped(image: U16, flow: F32) -> U16:
    """Take each pixel's value from where it was by the flow, interpolated linearly."""
    height, width = image.shape
    found = np.zeros((height, width), dtype=np.uint16)
    h, w = flow.shape[:2]
    across, down = np.float32(width / w), np.float32(height / h)
    left, share = np.empty(width, dtype=np.int64), np.empty(width, dtype=np.float32)
    for c in range(width):
        place = min(max((c + 0.5) * w / width - 0.5, 0.0), w - 1.0)
        left[c] = min(int(place), max(w - 2, 0))
        share[c] = place - left[c]
    beside = min(1, w - 1)
    along = np.empty((2, w), dtype=np.float32)
    half = np.float32(0.5)
    for r in range(height):
        place = min(max((r + 0.5) * h / height - 0.5, 0.0), h - 1.0)
        top = min(int(place), max(h - 2, 0))
        below, part = min(top + 1, h - 1), np.float32(place - top)
        for c in range(w):
            along[0, c] = across * (flow[top, c, 0] + part * (flow[below, c, 0] - flow[top, c, 0]))
            along[1, c] = down * (flow[top, c, 1] + part * (flow[below, c, 1] - flow[top, c, 1]))
        for c in range(width):
            n = left[c]
            u = along[0, n] + share[c] * (along[0, n + beside] - along[0, n])
            v = along[1, n] + share[c] * (along[1, n + beside] - along[1, n])
            row, column = r + int(np.floor(v + half)), c + int(np.floor(u + half))
            if 0 <= row < height and 0 <= column < width:
                found[r, c] = image[row, column]
    return found
