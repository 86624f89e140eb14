"""Surfaces fitted to parts of a grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.grid import DepthGrid
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.inverse_depth import DepthFitter


def fit_of(grid: DepthGrid, mask: NDArray[np.bool_], config: SegmentationConfig) -> Fit:
    """Fit a surface to marked pixels of a grid."""
    ((_, fit),) = DepthFitter(grid, config).of_pixels([np.flatnonzero(mask)])
    return fit


def fits_of(grid: DepthGrid, labels: NDArray[np.int32], config: SegmentationConfig) -> list[Fit]:
    """Fit a surface to each label from 1 on."""
    return [fit for _, fit in DepthFitter(grid, config).of_labels(labels, np.arange(labels.max() + 1))]
