"""Smooth borders: a concave turn that one surface explains as well as two is no crease."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.border_statistics import BorderStatistics, in_contact
from nurbseg.segmentation.labels.strips import BorderStrips
from nurbseg.segmentation.points.depth_grid import DepthGrid
from nurbseg.segmentation.points.grid import Window
from nurbseg.segmentation.surfaces.inverse_depth import residuals_of_fit
from nurbseg.segmentation.surfaces.noise import SQUARE_MOST

#: The strip that is looked at on each side of a border: pixels of an image 640 wide up to a depth of 0.8 m,
#: from there on as wide in proportion to depth, since the noise in metres grows faster than a pixel does.
_STRIP_PX = 12.0
_STRIP_PX_PER_M = 15.0
_STRIP_POINTS_LEAST = 20
#: Squared residuals of one surface over those of two, at most; where both are far below the noise (by this
#: share of its deviation, the rounding of depths) their ratio says nothing.
_RATIO_MOST = 2.0
_ROUNDING_SHARE = 0.3
#: One surface leaves no more than noise up to this mean of its squared residuals, in units of the noise and
#: each limited, and where less than this share lies beyond three deviations.
_MEAN_MOST, _FAR_SHARE_MOST = 2.2, 0.05


def smooth_borders(
    found: Sequence[BorderStatistics], on_grid: NDArray[np.int32], grid: DepthGrid, config: SegmentationConfig
) -> list[bool]:
    """Say of each border whether it is concave and one surface explains both sides.

    It must leave no more than noise, and not clearly more than two surfaces, one on each side: far from
    the camera noise hides a crease from the first test, and only the second one sees it.

    Parameters
    ----------
    found : sequence of BorderStatistics
        Each of two labels.
    on_grid : (h, w) int32
        Labels of the grid pixels; 0 where there is no point.
    grid : DepthGrid
        The points.
    config : SegmentationConfig
        Noise and concavity; a border that is merged for its concavity anyway is not asked about.

    Returns
    -------
    list of bool
        False also where the surfaces are not in contact, and where there are too few points to tell.
    """
    asked = [_is_asked(each, config) for each in found]
    if not any(asked):
        return asked
    strips = BorderStrips(on_grid)
    return [ask and _is_smooth(each, strips, grid, config) for ask, each in zip(asked, found, strict=True)]


def _is_asked(border: BorderStatistics, config: SegmentationConfig) -> bool:
    """Say whether two surfaces are in contact and not to be merged for their concavity."""
    if not in_contact(border.samples, border.touching):
        return False
    return (
        not config.extended.merge_crease
        or border.concavity_sum >= config.extended.concavity_max * border.touching
    )


def _is_smooth(
    border: BorderStatistics, strips: BorderStrips, grid: DepthGrid, config: SegmentationConfig
) -> bool:
    width_px = _STRIP_PX * grid.unit_px
    window, strip = strips.strip(border.first, border.second, _reach(width_px, grid))
    inverse_depth = grid.inverse_depth[window[0] : window[2], window[1] : window[3]][strip > 0]
    if inverse_depth.size == 0:
        return False
    wider_px = _STRIP_PX_PER_M * _median(1.0 / inverse_depth) * grid.unit_px
    if wider_px > width_px:
        window, strip = strips.strip(border.first, border.second, _reach(wider_px, grid))
    points = np.count_nonzero(strip)
    if points < _STRIP_POINTS_LEAST:
        return False

    one, explained = _squares(window, strip > 0, grid, config)
    if not explained:
        return False
    two = sum(_squares(window, strip == side, grid, config)[0] for side in (1, 2))
    rounding = points * (_ROUNDING_SHARE * config.extended.inverse_depth_noise) ** 2
    return bool(one + rounding <= _RATIO_MOST * (two + rounding))


def _reach(width_px: float, grid: DepthGrid) -> int:
    """Return a width in places of the grid, at least one."""
    return max(1, round(width_px / grid.step))


def _median(values: NDArray[np.float32]) -> float:
    middle = [(values.size - 1) // 2, values.size // 2]
    return float(np.partition(values, middle)[middle].mean())


def _squares(
    window: Window, marked: NDArray[np.bool_], grid: DepthGrid, config: SegmentationConfig
) -> tuple[float, bool]:
    """Fit marked grid pixels; return the sum of squared residuals, 1/m^2, and whether noise explains them."""
    left, top, width, height = cv2.boundingRect(marked.view(np.uint8))
    if width == 0:
        return 0.0, True
    mask = np.ascontiguousarray(marked[top : top + height, left : left + width])
    top, left = window[0] + top, window[1] + left
    residuals_per_m = residuals_of_fit(grid, (top, left, top + height, left + width), mask, config)
    squares = np.square(residuals_per_m / config.extended.inverse_depth_noise)
    far = np.count_nonzero(squares > 9.0)
    explained = np.minimum(squares, SQUARE_MOST).mean() < _MEAN_MOST and far < _FAR_SHARE_MOST * squares.size
    return float(residuals_per_m @ residuals_per_m), bool(explained)
