"""Labels warped by optical flow from the frame before."""

import cv2
import numpy as np
from numpy.typing import NDArray

#: Share of the mean brightness by which it changes with exposure or light, not only with the scene.
_EXPOSURE_SHARE = 0.15


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
    if abs(now.mean() - before.mean()) > _EXPOSURE_SHARE * before.mean():
        before = _exposed_like(now, before)
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    found = search.calc(now, before, np.zeros((*now.shape, 2), dtype=np.float32))
    return np.asarray(found, dtype=np.float32)


def _exposed_like(now: NDArray[np.uint8], before: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the gray image before with the brightness of the same rank in that of now."""
    ranks, ranks_before = (np.bincount(gray.reshape(-1), minlength=256).cumsum() for gray in (now, before))
    table = np.searchsorted(ranks, ranks_before).clip(max=255).astype(np.uint8)
    return np.asarray(table[before], dtype=np.uint8)


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
    (height, width), (h, w) = image.shape, flow.shape[:2]
    # OpenCV's types know neither factors by channel, for which NumPy takes twenty times as long, nor maps of
    # both coordinates.
    factors = width / w, height / h, 0.0, 0.0
    scaled = cv2.multiply(flow, factors)  # type: ignore[call-overload]
    path = cv2.resize(scaled, (width, height), interpolation=cv2.INTER_LINEAR)
    nearest = cv2.INTER_NEAREST | cv2.WARP_RELATIVE_MAP
    return np.asarray(cv2.remap(image, path, None, nearest))  # type: ignore[call-overload]
