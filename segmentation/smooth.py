"""Smooth borders: a concave turn that one surface explains as well as two is no crease."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.contact import Meeting, in_contact
from nurbseg.segmentation.inverse_depth import DepthGrid, residuals_of_fit
from nurbseg.segmentation.noise import explained_by_noise

#: The strip that is looked at on each side of a border: pixels of an image 640 wide up to a depth of 0.8 m,
#: from there on as wide in proportion to depth, since the noise in metres grows faster than a pixel does.
_STRIP_PX = 12.0
_STRIP_PX_PER_M = 15.0
_STRIP_POINTS_LEAST = 20
#: Squared residuals of one surface over those of two, at most; where both are far below the noise (by this
#: share of its deviation, the rounding of depths) their ratio says nothing.
_RATIO_MOST = 2.0
_ROUNDING_SHARE = 0.3


def is_smooth(
    meeting: Meeting, labels: NDArray[np.int32], grid: DepthGrid, config: SegmentationConfig
) -> bool:
    """Say whether one surface explains both sides of a concave border.

    It must leave no more than noise, and not clearly more than two surfaces, one on each side: far from
    the camera noise hides a crease from the first test, and only the second one sees it.

    Parameters
    ----------
    meeting : Meeting
        Of two labels.
    labels : (H, W) int32
        Labels of every pixel.
    grid : DepthGrid
        The points.
    config : SegmentationConfig
        Noise and concavity; a border that is merged for its concavity anyway is not asked about.

    Returns
    -------
    bool
        False also where the surfaces are not in contact, and where there are too few points to tell.
    """
    if not in_contact(meeting.samples, meeting.touching):
        return False
    if config.merge_crease and meeting.concavity_sum < config.concavity_max * meeting.touching:
        return False
    on_grid = np.where(grid.valid, labels[:: grid.step, :: grid.step], 0)
    first, second = on_grid == meeting.first, on_grid == meeting.second
    width_px = _STRIP_PX * grid.unit_px
    strip = _strip(first, second, width_px / grid.step)
    if not strip.any():
        return False
    depth_m = float(np.median(1.0 / grid.per_m[strip]))
    wider_px = _STRIP_PX_PER_M * depth_m * grid.unit_px
    if wider_px > width_px:
        strip = _strip(first, second, wider_px / grid.step)
    if np.count_nonzero(strip) < _STRIP_POINTS_LEAST:
        return False

    one, explained = _squares(strip, grid, config)
    if not explained:
        return False
    two = sum(_squares(strip & side, grid, config)[0] for side in (first, second))
    rounding = np.count_nonzero(strip) * (_ROUNDING_SHARE * config.noise_per_m) ** 2
    return bool(one + rounding <= _RATIO_MOST * (two + rounding))


def _strip(first: NDArray[np.bool_], second: NDArray[np.bool_], width: float) -> NDArray[np.bool_]:
    """Find the places of either label within a distance of the other."""
    side = 2 * max(1, round(width)) + 1
    kernel = np.ones((side, side), dtype=np.uint8)
    near_second = cv2.dilate(second.view(np.uint8), kernel) > 0
    near_first = cv2.dilate(first.view(np.uint8), kernel) > 0
    strip: NDArray[np.bool_] = (first & near_second) | (second & near_first)
    return strip


def _squares(marked: NDArray[np.bool_], grid: DepthGrid, config: SegmentationConfig) -> tuple[float, bool]:
    """Fit marked places; return the sum of squared residuals, 1/m^2, and whether noise explains them."""
    places = np.flatnonzero(marked)
    if places.size == 0:
        return 0.0, True
    _, _, window = grid.points.locate(places)
    mask = marked[window[0] : window[2], window[1] : window[3]]
    residuals_per_m = residuals_of_fit(grid, window, mask, config)
    explained = explained_by_noise(residuals_per_m, mask, config.noise_per_m, rim=True)
    return float(residuals_per_m @ residuals_per_m), explained


__all__ = ["is_smooth"]
