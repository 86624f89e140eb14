"""Preparation of depth images: range, crop, smoothing, averaging, filling of holes."""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.frame import RGBDFrame
from nurbseg.segmentation.config import DepthConfig

#: Side of the smoothing window and standard deviation of its weights, pixels.
_WINDOW_PX = 5
_WEIGHT_PX = 1.5
#: Inverse depths farther apart than this, in standard deviations of the noise, are of different surfaces.
_NOISE_DEVIATIONS = 3.0


class DepthPreparation:
    """Prepares depth images in the order of their frames, as `DepthConfig` says.

    Color, ground truth and image size stay. Pixels that are left out get depth 0.

    Parameters
    ----------
    config : DepthConfig
        What to do.
    inverse_depth_noise : float
        Standard deviation of inverse depth, 1/m.
    """

    def __init__(self, config: DepthConfig, inverse_depth_noise: float) -> None:
        self._config = config
        self._is_idle = config == DepthConfig()
        self._tolerance = np.float32(_NOISE_DEVIATIONS * inverse_depth_noise)
        self._mean: NDArray[np.float32] | None = None
        self._count = np.zeros((0, 0), dtype=np.float32)

    def prepared(self, frame: RGBDFrame) -> RGBDFrame:
        """Return a frame with its depth prepared; the frame itself where nothing is to be done."""
        if self._is_idle:
            return frame
        config = self._config
        depth_mm = frame.depth_mm.copy()
        depth_mm[depth_mm < 1e3 * config.range_min_m] = 0
        if config.range_max_m:
            depth_mm[depth_mm > 1e3 * config.range_max_m] = 0
        if config.crop is not None:
            left, top, width, height = config.crop
            inside = np.zeros(depth_mm.shape, dtype=np.bool_)
            inside[top : top + height, left : left + width] = True
            depth_mm[~inside] = 0
        if config.smoothing == "median":
            depth_mm = _median(depth_mm)
        elif config.smoothing == "bilateral":
            smoothed = cv2.bilateralFilter(_inverse(depth_mm), _WINDOW_PX, float(self._tolerance), _WEIGHT_PX)
            depth_mm = _millimeters(np.asarray(smoothed, dtype=np.float32), depth_mm > 0)
        if config.average_frames > 1:
            depth_mm = self._averaged(depth_mm)
        if config.holes_px:
            depth_mm = _filled(depth_mm, config.holes_px)
        return replace(frame, depth_mm=depth_mm)

    def _averaged(self, depth_mm: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Average each pixel's inverse depth over the last frames since it changed."""
        now = _inverse(depth_mm)
        if self._mean is None or self._mean.shape != now.shape:
            self._mean, self._count = now, np.ones(now.shape, dtype=np.float32)
            return depth_mm
        same = np.abs(now - self._mean) <= self._tolerance
        self._count = np.where(same, np.minimum(self._count + 1.0, self._config.average_frames), 1.0)
        self._mean = np.where(same, self._mean + (now - self._mean) / self._count, now).astype(np.float32)
        return _millimeters(self._mean, depth_mm > 0)


def _inverse(depth_mm: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Return inverse depth, 1/m; 0 where there is no depth, which is far from any that a camera measures."""
    inverse = np.zeros(depth_mm.shape, dtype=np.float32)
    np.divide(np.float32(1e3), depth_mm, out=inverse, where=depth_mm > 0)
    return inverse


def _millimeters(inverse: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.uint16]:
    depth_mm = np.zeros(inverse.shape, dtype=np.float32)
    np.divide(np.float32(1e3), inverse, out=depth_mm, where=valid)
    return np.rint(np.minimum(depth_mm, 65535.0)).astype(np.uint16)


def _median(depth_mm: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the median around each pixel; one without depth counts as its nearest neighbor with depth."""
    return np.where(depth_mm > 0, cv2.medianBlur(_filled(depth_mm, _WINDOW_PX), _WINDOW_PX), depth_mm)


def _filled(depth_mm: NDArray[np.uint16], most_px: int) -> NDArray[np.uint16]:
    """Give pixels without depth that of the nearest pixel that has one, `most_px` away at most."""
    distances, nearest = cv2.distanceTransformWithLabels(
        (depth_mm == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE, labelType=cv2.DIST_LABEL_PIXEL
    )
    # Each pixel with depth has a label of its own.
    depth_of = np.zeros(int(nearest.max()) + 1, dtype=np.uint16)
    depth_of[nearest[depth_mm > 0]] = depth_mm[depth_mm > 0]
    return np.where(distances <= most_px, depth_of[nearest], depth_mm)
