"""Features of a frame on the grid: points, their adjacency, and raw vectors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.features import raw_vectors
from nurbseg.segmentation.labels.regions import PixelAdjacency, pixel_adjacency
from nurbseg.segmentation.points.grid import DepthGrid, depth_grid, grid_step
from nurbseg.segmentation.points.normals import facet_normals
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.inverse_depth import DepthFitter


@dataclass(frozen=True, eq=False)
class GridFeatures:
    """A frame on the grid on which splits are decided.

    Parameters
    ----------
    cloud : PointMap
        The frame.
    config : SegmentationConfig
        Gap, noise and windows of normals.
    grid : DepthGrid
        Points and inverse depths.
    adjacency : PixelAdjacency
        Neighbors without a gap between them.
    """

    cloud: PointMap
    config: SegmentationConfig
    grid: DepthGrid
    adjacency: PixelAdjacency

    @cached_property
    def fitter(self) -> DepthFitter:
        """Fits surfaces to grid pixels, and has the sums of those that were fitted."""
        return DepthFitter(self.grid, self.config)

    @cached_property
    def normals(self) -> NDArray[np.float32]:
        """Unit normal of every grid pixel, (h * w, 3) float32; 0 where there is no point."""
        grid, extended = self.grid, self.config.extended
        half_window = max(1, round(0.5 * extended.normal_window_px * grid.unit_px / grid.step - 0.5))
        window, noise_per_m = 2 * half_window + 1, extended.inverse_depth_noise
        points = grid.inverse_depth, grid.valid, grid.rays
        return facet_normals(*points, step=grid.step, window=window, noise_per_m=noise_per_m).reshape(-1, 3)

    def raw_vectors(self, grid_pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return Lab color, position and normal of flat grid pixels that have a point, (N, 9) float32."""
        vectors = raw_vectors(self.cloud, self.grid.pixels(grid_pixels))
        return np.concatenate([vectors, self.normals[grid_pixels]], axis=1)

    def grid_pixels_min(self, config: SegmentationConfig) -> float:
        """Return the fewest grid pixels of a segment."""
        return config.extended.piece_pixels_min * self.grid.pixel_share


def grid_features(cloud: PointMap, config: SegmentationConfig) -> GridFeatures:
    """Compute inverse depths and adjacency on the grid that is set; vectors follow where they are read."""
    grid = depth_grid(cloud, grid_step(cloud.valid, config.decimation))
    adjacency = pixel_adjacency(grid.inverse_depth, grid.valid, config.extended.inverse_depth_gap)
    return GridFeatures(cloud, config, grid, adjacency)
