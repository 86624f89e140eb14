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

#: Normals in a box of more than this share of the grid are computed on all of it.
_LARGE_SHARE = 0.25


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
    def _normals(self) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Normals of the grid pixels, and which of them are known."""
        return np.zeros((*self.grid.shape, 3), dtype=np.float32), np.zeros(self.grid.shape, dtype=np.bool_)

    def normals(self, grid_pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return the unit normals of flat grid pixels, (N, 3) float32; 0 where there is no point.

        They are computed where they are asked for: in a box around, or everywhere if that is a large part.
        """
        normals, is_known = self._normals
        if not is_known.reshape(-1)[grid_pixels].all():
            grid, extended = self.grid, self.config.extended
            rows, columns = np.divmod(grid_pixels, grid.shape[1])
            box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
            if _LARGE_SHARE * is_known.size < is_known[box].size:
                box = slice(0, None), slice(0, None)
            half_window = max(1, round(0.5 * extended.normal_window_px * grid.unit_px / grid.step - 0.5))
            window, noise_per_m = 2 * half_window + 1, extended.inverse_depth_noise
            points = grid.inverse_depth, grid.valid, grid.rays
            normals[box] = facet_normals(
                *points, step=grid.step, window=window, noise_per_m=noise_per_m, box=box
            )
            is_known[box] = True
        return normals.reshape(-1, 3)[grid_pixels]

    def raw_vectors(self, grid_pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return Lab color, position and normal of flat grid pixels that have a point, (N, 9) float32."""
        vectors = raw_vectors(self.cloud, self.grid.pixels(grid_pixels))
        return np.concatenate([vectors, self.normals(grid_pixels)], axis=1)

    def grid_pixels_min(self, config: SegmentationConfig) -> float:
        """Return the fewest grid pixels of a segment."""
        return config.extended.piece_pixels_min * self.grid.pixel_share


def grid_features(cloud: PointMap, config: SegmentationConfig) -> GridFeatures:
    """Compute inverse depths and adjacency on the grid that is set; vectors follow where they are read."""
    grid = depth_grid(cloud, grid_step(cloud.valid, config.decimation))
    adjacency = pixel_adjacency(grid.inverse_depth, grid.valid, config.extended.inverse_depth_gap)
    return GridFeatures(cloud, config, grid, adjacency)
