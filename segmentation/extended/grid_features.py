"""Features of a frame on the grid: points, their adjacency, and raw vectors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.features import lab
from nurbseg.segmentation.labels.regions import PixelAdjacency, pixel_adjacency
from nurbseg.segmentation.points.grid import DepthGrid, depth_grid, grid_step
from nurbseg.segmentation.points.normals import facet_normals
from nurbseg.segmentation.points.registration import PointMap


@dataclass(frozen=True, slots=True, eq=False)
class GridFeatures:
    """A frame on the grid on which splits are decided.

    Parameters
    ----------
    grid : DepthGrid
        Points and inverse depths.
    adjacency : PixelAdjacency
        Neighbors without a gap between them.
    raw : (h * w, 9) float32
        Lab color, position and normal of every grid pixel that has a point.
    """

    grid: DepthGrid
    adjacency: PixelAdjacency
    raw: NDArray[np.float32]

    def grid_pixels_min(self, config: SegmentationConfig) -> float:
        """Return the fewest grid pixels of a segment."""
        return config.extended.piece_pixels_min * self.grid.pixel_share


def grid_features(cloud: PointMap, config: SegmentationConfig) -> GridFeatures:
    """Compute inverse depths, adjacency and raw vectors on the grid that is set."""
    grid = depth_grid(cloud, grid_step(cloud.valid, config.decimation))
    # Channel by channel: pixels of three bytes would be copied one by one, four times as slowly.
    channels = [cloud.color[:: grid.step, :: grid.step, k].ravel() for k in range(3)]
    color = lab(np.stack(channels, axis=1))
    normals = _normals(grid, config)
    raw = _side_by_side(color, grid.coordinates_m, normals)
    adjacency = pixel_adjacency(grid.inverse_depth, grid.valid, config.extended.inverse_depth_gap)
    return GridFeatures(grid, adjacency, raw)


@compiled
def _side_by_side(color: F32, coordinates_m: F32, normals: F32) -> F32:
    height, width, _ = normals.shape
    raw = np.empty((height * width, 9), dtype=np.float32)
    for y in range(height):
        for x in range(width):
            row = raw[y * width + x]
            for k in range(3):
                row[k] = color[y * width + x, k]
                row[3 + k] = coordinates_m[k, y, x]
                row[6 + k] = normals[y, x, k]
    return raw


def _half_window(grid: DepthGrid, config: SegmentationConfig) -> int:
    """Return how far the windows for normals reach, grid pixels."""
    return max(1, round(0.5 * config.extended.normal_window_px * grid.unit_px / grid.step - 0.5))


def _normals(grid: DepthGrid, config: SegmentationConfig) -> NDArray[np.float32]:
    return facet_normals(
        grid.inverse_depth,
        grid.valid,
        grid.rays,
        step=grid.step,
        window=2 * _half_window(grid, config) + 1,
        noise_per_m=config.extended.inverse_depth_noise,
    )
