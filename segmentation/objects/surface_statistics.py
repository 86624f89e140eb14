"""Size, center and plane of each surface."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I32, compiled
from nurbseg.segmentation.points.grid import DepthGrid

#: Ridge for the slopes of a plane, so that a row of points has one as well.
_RIDGE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceStatistics:
    """Size, center and plane of the surfaces, by label from 0 on, which is none.

    Parameters
    ----------
    pixels : (L,) float64
        In pixels of a 640-wide image.
    center_m : (L, 3) float64
        Mean of its points, meters.
    normal : (L, 3) float64
        Unit normal of the plane of inverse depth that fits its points best, toward the camera.
    """

    pixels: NDArray[np.float64]
    center_m: NDArray[np.float64]
    normal: NDArray[np.float64]


def surface_statistics(labels: NDArray[np.int32], count: int, grid: DepthGrid) -> SurfaceStatistics:
    """Measure every surface.

    Parameters
    ----------
    labels : (h, w) int32
        Of the grid pixels, 1 to `count`; 0 where there is no point.
    count : int
        Number of labels.
    grid : DepthGrid
        The points.

    Returns
    -------
    SurfaceStatistics
        A label without a pixel has zeros.
    """
    sums = np.zeros((count + 1, 12))
    _sum(np.ascontiguousarray(labels), grid.inverse_depth, grid.coordinates_m, sums)
    counts = sums[:, 0]
    # Columns and rows from the center of the image, in image widths.
    (_, u, v, d, uu, uv, vv, ud, vd, *center) = (sums / np.maximum(counts, 1.0)[:, np.newaxis]).T
    matrix = np.stack([uu - u * u + _RIDGE, uv - u * v, uv - u * v, vv - v * v + _RIDGE], axis=1)
    slopes_u, slopes_v = np.linalg.solve(
        matrix.reshape(-1, 2, 2), np.stack([ud - u * d, vd - v * d], axis=1)[..., np.newaxis]
    )[..., 0].T

    height, width = labels.shape
    across_px = width * grid.step
    x, y = grid.rays.at(
        u * across_px + (width - 1) / 2 * grid.step, v * across_px + (height - 1) / 2 * grid.step
    )
    focal_u, focal_v = grid.rays.focal_px
    along_u, along_v = slopes_u * focal_u / across_px, slopes_v * focal_v / across_px
    normal = -np.stack([along_u, along_v, d - along_u * x - along_v * y])
    normal /= np.maximum(np.sqrt(np.square(normal).sum(axis=0)), 1e-12)
    return SurfaceStatistics(
        counts * (grid.step / grid.unit_px) ** 2,
        np.stack(center, axis=1),
        normal.T,
    )


@compiled
def _sum(
    labels: I32,
    inverse_depth: F32,
    coordinates_m: F32,
    sums: F64,
) -> None:
    """Add up 1, u, v, d, their products and the points by label."""
    height, width = labels.shape
    for r in range(height):
        v = (r - 0.5 * (height - 1)) / width
        for c in range(width):
            d = np.float64(inverse_depth[r, c])
            if labels[r, c] == 0 or not d > 0:
                continue
            own, u = sums[labels[r, c]], (c - 0.5 * (width - 1)) / width
            own[0] += 1.0
            own[1] += u
            own[2] += v
            own[3] += d
            own[4] += u * u
            own[5] += u * v
            own[6] += v * v
            own[7] += u * d
            own[8] += v * d
            for axis in range(3):
                own[9 + axis] += coordinates_m[axis, r, c]
