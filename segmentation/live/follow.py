"""Following leaves into the next frame: surfaces are moved, labels grow into unlabeled pixels."""

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I32, Bool, compiled
from nurbseg.segmentation.labels.images import inner_pixels
from nurbseg.segmentation.surfaces.lattice import Samples, SurfaceLattice

#: Limit of the change of inverse depth by motion between two frames; more is another surface, 1/m.
_MOTION_MOST_PER_M = 0.15
#: Passes in which labels grow.
_GROWTH = 12


def moved_lattice(
    lattice: SurfaceLattice,
    labels: NDArray[np.int32],
    inverse_depth: NDArray[np.float32],
    noise_per_m: float,
) -> SurfaceLattice:
    """Move every surface by the linear change of its points' inverse depth.

    This follows any motion of a plane, and small motions of other surfaces. Grid pixels next to another label
    do not count.

    Parameters
    ----------
    lattice : SurfaceLattice
        Surfaces of the labels 1, 2, ... in the frame before.
    labels : (h, w) int32
        Labels on the grid.
    inverse_depth : (h, w) float32
        Inverse depth of this frame on the grid, 1/m.
    noise_per_m : float
        Standard deviation of inverse depth, 1/m.

    Returns
    -------
    SurfaceLattice
        The moved ones.
    """
    # First the mean change, then a linear change of the pixels that agree with it.
    count = len(lattice.samples.windows)
    change = lattice.image(labels)
    sums = np.zeros((count, 3))
    _sum_changes(labels, inner_pixels(labels), inverse_depth, change, sums)
    mean, square = np.ascontiguousarray(sums[:, 1:].T) / np.maximum(sums[:, 0], 1.0)
    spread = np.sqrt(np.maximum(square - np.square(mean), 0.0))
    limit = np.maximum(6.0 * noise_per_m, 2.0 * spread)
    sums = np.zeros((count, 9))
    _sum_moments(labels, change, mean, limit, sums)
    n = sums[:, 0]
    x, y, c, xx, yy, xy, xc, yc = sums[:, 1:].T / np.maximum(n, 1.0)
    # A ridge of one row and column of points keeps slivers from tilting.
    xx, yy = n * (xx - x * x) + 4.0 * n + 1.0, n * (yy - y * y) + 4.0 * n + 1.0
    xy, xc, yc = n * (xy - x * y), n * (xc - x * c), n * (yc - y * c)
    determinant = xx * yy - xy * xy
    along_x, along_y = (yy * xc - xy * yc) / determinant, (xx * yc - xy * xc) / determinant
    return lattice.changed(mean + c - along_x * x - along_y * y, along_x, along_y)


def grown_labels(
    labels: NDArray[np.int32],
    inverse_depth: NDArray[np.float32],
    lattice: SurfaceLattice,
    limits_per_m: NDArray[np.float32],
) -> NDArray[np.int32]:
    """Let labels grow into unlabeled grid pixels that their surfaces explain.

    Parameters
    ----------
    labels : (h, w) int32
        Labels on the grid; 0 is none.
    inverse_depth : (h, w) float32
        Inverse depth, 1/m; 0 where there is no point, and so no label.
    lattice : SurfaceLattice
        Of the labels' surfaces.
    limits_per_m : (labels + 1,) float32
        Residual from which a label's surface does not explain a grid pixel, 1/m.

    Returns
    -------
    (h, w) int32
        The labels; grid pixels that no neighbor's surface explains stay 0.
    """
    grown = labels.copy()
    _grow(grown, inverse_depth, lattice.samples, limits_per_m, _GROWTH)
    return grown


@compiled
def _sum_changes(labels: I32, inner: Bool, inverse_depth: F32, change: F32, sums: F64) -> None:
    """Turn inverse depths into changes, NaN where these do not count; sum 1, c, cc by label."""
    height, width = labels.shape
    for r in range(height):
        c = 0
        while c < width:
            # Grid pixels in a row with the same label are summed together.
            label = labels[r, c]
            n, total, squares = 0, 0.0, 0.0
            while c < width and labels[r, c] == label:
                moved = np.float64(inverse_depth[r, c] - change[r, c])
                if inner[r, c] and abs(moved) < _MOTION_MOST_PER_M:
                    n, total, squares = n + 1, total + moved, squares + moved * moved
                    change[r, c] = moved
                else:
                    change[r, c] = np.nan
                c += 1
            own = sums[label]
            own[0], own[1], own[2] = own[0] + n, own[1] + total, own[2] + squares


@compiled
def _sum_moments(labels: I32, change: F32, mean: F64, limit: F64, sums: F64) -> None:
    """Sum by label over changes that agree with their mean: 1, x, y, c, xx, yy, xy, xc, yc."""
    height, width = labels.shape
    for r in range(height):
        c = 0
        while c < width:
            label = labels[r, c]
            n = x = xx = d = xd = 0.0
            while c < width and labels[r, c] == label:
                beyond = change[r, c] - mean[label]
                if abs(beyond) < limit[label]:
                    n, x, xx, d, xd = n + 1.0, x + c, xx + c * c, d + beyond, xd + c * beyond
                c += 1
            own = sums[label]
            for k, each in enumerate((n, x, r * n, d, xx, r * r * n, r * x, xd, r * d)):
                own[k] += each


@compiled
def _grow(labels: I32, inverse_depth: F32, samples: Samples, limits: F32, passes: int) -> None:
    """Give unlabeled grid pixels the adjacent label that explains them best, all of a pass at once."""
    values, windows = samples
    height, width = labels.shape
    grid_pixels, found = np.empty(labels.size, dtype=np.int64), np.empty(labels.size, dtype=np.int32)
    flat = labels.reshape(-1)
    depths = inverse_depth.reshape(-1)
    waiting = 0
    for pixel in range(flat.size):
        if flat[pixel] == 0 and depths[pixel] > 0:
            grid_pixels[waiting] = pixel
            waiting += 1
    for _ in range(passes):
        grown = 0
        for n in range(waiting):
            row, column = divmod(grid_pixels[n], width)
            least = np.float32(np.inf)
            found[n] = 0
            for down, across in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                r, c = row + down, column + across
                if not (0 <= r < height and 0 <= c < width):
                    continue
                label = labels[r, c]
                if label == 0:
                    continue
                top, left, bottom, right, start = windows[label]
                if not (top <= row < bottom and left <= column < right):
                    continue
                at = start + (row - top) * (right - left) + column - left
                residual = abs(values[at] - depths[grid_pixels[n]])
                if residual < limits[label] and residual < least:
                    least = residual
                    found[n] = label
            grown += found[n] > 0
        if grown == 0:
            return
        left_over = 0
        for n in range(waiting):
            if found[n] > 0:
                flat[grid_pixels[n]] = found[n]
            else:
                grid_pixels[left_over] = grid_pixels[n]
                left_over += 1
        waiting = left_over
