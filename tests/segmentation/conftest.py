"""Clouds with a known shape, seen by a plain camera."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from nurbseg.segmentation.registration import PointMap

CloudOf = Callable[..., PointMap]


@pytest.fixture
def cloud_of() -> CloudOf:
    """A function that back-projects a depth image (metres, NaN for none) with one color or an image."""

    def build(depth_m: NDArray[np.float64], color: object = (120, 120, 120)) -> PointMap:
        height, width = depth_m.shape
        focal = 0.8 * width
        rows, columns = np.mgrid[:height, :width]
        points = np.empty((height, width, 3), dtype=np.float32)
        points[..., 0] = (columns - 0.5 * (width - 1)) * depth_m / focal
        points[..., 1] = (rows - 0.5 * (height - 1)) * depth_m / focal
        points[..., 2] = depth_m
        image = np.empty((height, width, 3), dtype=np.uint8)
        image[:] = np.asarray(color, dtype=np.uint8)
        return PointMap(points, image, np.isfinite(depth_m))

    return build
