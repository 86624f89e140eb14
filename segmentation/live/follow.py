"""Following labels into the next frame: surfaces move, keep the points that they explain, and grow."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I32, I64, U16, Bool, compiled, inlined
from nurbseg.segmentation.points.grid import DepthGrid
from nurbseg.segmentation.surfaces.bspline import CUBIC, even_values
from nurbseg.segmentation.surfaces.surface_table import Splines, SurfaceTable, dot, spline_at

#: Limit of the change of inverse depth by motion between two frames; more is another surface, 1/m.
_MOTION_MOST_PER_M = np.float32(0.15)
#: A surface does not explain a point that is farther from it than so many of its deviations, at least noise.
_UNEXPLAINED_DEVIATIONS = 10.0
#: Share of the points that no surface explains, or of those without a label, that mean a new scene.
_CHANGED_SHARE, _UNKNOWN_SHARE = 0.08, 0.4
#: A label on fewer grid pixels than this share of the smallest size has vanished.
VANISHED_SHARE = 0.25
#: Passes in which labels grow.
_GROWTH = 12
#: Rounding of knots that are on the grid, knot spacings.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """Labels of the frame before on the grid of this one, as far as their surfaces explain its points.

    Parameters
    ----------
    labels : (h, w) int32
        1 to the number of surfaces; 0 where no surface explains the point, or there is none.
    planes : (labels + 1, 3) float64
        By which the inverse depth of each surface has changed: at the first row and column, 1/m, and along
        one grid pixel of columns and of rows.
    unexplained : float
        Share of the labeled points that their surface did not explain.
    is_same_scene : bool
        Whether enough is explained to continue the tree; only then labels have grown.
    """

    labels: NDArray[np.int32]
    planes: NDArray[np.float64]
    unexplained: float
    is_same_scene: bool


def follow_labels(
    before: NDArray[np.uint16],
    surfaces: SurfaceTable,
    rms_per_m: Sequence[float],
    grid: DepthGrid,
    noise_per_m: float,
    grid_pixels_min: float,
) -> Followed:
    """Carry labels into a frame: surfaces move with their points, which keep a label that explains them.

    Every surface moves by the linear change of its points' inverse depth. This follows any motion of a plane,
    and small motions of other surfaces. Grid pixels next to another label do not count. Then labels grow into
    the grid pixels beside them that their surfaces explain.

    Parameters
    ----------
    before : (H, W) uint16
        Labels of the frame before at their present place; 0 for none.
    surfaces, rms_per_m
        The surfaces of these labels in the frame before, and their root mean square residuals, 1/m.
    grid : DepthGrid
        This frame.
    noise_per_m : float
        Standard deviation of inverse depth, 1/m.
    grid_pixels_min : float
        Smallest size of a component, grid pixels.
    """
    limits = (_UNEXPLAINED_DEVIATIONS * np.maximum([0.0, *rms_per_m], noise_per_m)).astype(np.float32)
    labels, planes = np.empty(grid.shape, dtype=np.int32), np.zeros((limits.size, 3))
    counts = np.zeros((2, limits.size), dtype=np.int64)
    splines, inverse_depth = surfaces.splines, grid.inverse_depth
    _follow(before, inverse_depth, grid.step, splines, noise_per_m, limits, labels, planes, counts)
    points, (known, explained) = np.count_nonzero(grid.valid), counts.sum(axis=1).tolist()
    unexplained = 1.0 - explained / max(1, known)
    is_same = unexplained <= _CHANGED_SHARE and known >= (1.0 - _UNKNOWN_SHARE) * points
    if is_same:
        # What was hardly shown has vanished: its pixels are for others to take.
        is_shown = counts[1] >= VANISHED_SHARE * grid_pixels_min
        _grow(labels, inverse_depth, grid.step, splines, planes, limits, is_shown, _GROWTH)
    return Followed(labels, planes, unexplained, is_same)


@compiled
def _follow(
    before: U16,
    inverse_depth: F32,
    step: int,
    splines: Splines,
    noise_per_m: float,
    limits: F32,
    labels: I32,
    planes: F64,
    counts: I64,
) -> None:
    """Move surfaces; keep the labels that they explain, and count by label how many there were and are."""
    height, width = labels.shape
    for r in range(height):
        line, own, depths = before[r * step], labels[r], inverse_depth[r]
        for c in range(width):
            own[c] = line[np.uint32(c * step)] if depths[c] > 0.0 else np.int32(0)
    runs = _runs(labels)
    change = np.empty((height, width), dtype=np.float32)
    _changes(runs, inverse_depth, step, splines, change)
    inner_change = change.copy()
    _leave_out_borders(labels, inner_change)
    means, sums = np.zeros((limits.size, 3)), np.zeros((limits.size, 9))
    _sum_means(runs, inner_change, means)
    for label in range(1, limits.size):
        # First the mean change, then a linear change of the pixels that agree with it.
        n = max(means[label, 0], 1.0)
        mean = means[label, 1] / n
        spread = math.sqrt(max(means[label, 2] / n - mean * mean, 0.0))
        means[label, 1], means[label, 2] = mean, max(6.0 * noise_per_m, 2.0 * spread)
    _sum_moments(runs, inner_change, means, sums)
    for label in range(1, limits.size):
        n, own, plane = sums[label, 0], sums[label, 1:] / max(sums[label, 0], 1.0), planes[label]
        x, y, d = own[0], own[1], own[2]
        # A ridge of one row and column of points keeps slivers from tilting.
        xx, yy = n * (own[3] - x * x) + 4.0 * n + 1.0, n * (own[4] - y * y) + 4.0 * n + 1.0
        xy, xd, yd = n * (own[5] - x * y), n * (own[6] - x * d), n * (own[7] - y * d)
        determinant = xx * yy - xy * xy
        plane[1], plane[2] = (yy * xd - xy * yd) / determinant, (xx * yd - xy * xd) / determinant
        plane[0] = means[label, 1] + d - plane[1] * x - plane[2] * y
    for n in range(runs.shape[0]):
        r, begin, end, label = runs[n]
        line, own, limit, kept = change[r], labels[r], limits[label], np.int32(0)
        start, slope = np.float32(planes[label, 0] + r * planes[label, 2]), np.float32(planes[label, 1])
        for c in range(begin, end):
            # False for NaN.
            is_explained = abs(line[c] - (start + slope * np.float32(c))) < limit
            own[c] = label if is_explained else np.int32(0)
            kept += np.int32(is_explained)
        counts[0, label] += end - begin
        counts[1, label] += kept


@compiled
def _runs(labels: I32) -> I32:
    """Find the runs of equal labels but 0: row, first column, one past the last, and label."""
    height, width = labels.shape
    runs, count = np.empty((labels.size, 4), dtype=np.int32), 0
    for r in range(height):
        own, c = labels[r], 0
        while c < width:
            label, begin = own[c], c
            while c < width and own[c] == label:
                c += 1
            if label > 0:
                runs[count, 0], runs[count, 1], runs[count, 2], runs[count, 3] = r, begin, c, label
                count += 1
    return runs[:count]


@inlined
def _reaches(position: float, functions: float) -> bool:
    """Whether a position, in knot spacings from the first knot, is where all functions of a spline are."""
    return CUBIC - _ROUNDING <= position <= functions + _ROUNDING


@compiled
def _changes(runs: I32, inverse_depth: F32, step: int, splines: Splines, change: F32) -> None:
    """Subtract from inverse depths those of their label's surface; NaN where that does not reach."""
    axes, weights, starts = splines
    for n in range(runs.shape[0]):
        r, begin, end, label = runs[n]
        depths, found = inverse_depth[r], change[r]
        position, length = (r * step - axes[label, 1, 0]) * axes[label, 1, 1], int(axes[label, 0, 2])
        reaches = length > 0 and _reaches(position, axes[label, 1, 2])
        if not reaches:
            found[begin:end] = np.nan
            continue
        span = min(max(int(position), CUBIC), int(axes[label, 1, 2]) - 1)
        B, first = even_values(position - span), starts[label] + (span - CUBIC) * length
        scale = step * axes[label, 0, 1]
        offset = -axes[label, 0, 0] * axes[label, 0, 1]
        c = begin
        while c < end:
            # The columns of a cell, where the surface is a polynomial.
            position = offset + c * scale
            span = min(max(int(position + _ROUNDING), CUBIC), length - 1)
            after = min(end, max(c + 1, math.ceil((span + 1 - _ROUNDING - offset) / scale)))
            if not _reaches(position, float(length)):
                after = c + 1 if position < CUBIC else end
                found[c:after] = np.nan
                c = after
                continue
            k = first + span - CUBIC
            p0, p1 = dot(B, weights, k, length), dot(B, weights, k + 1, length)
            p2, p3 = dot(B, weights, k + 2, length), dot(B, weights, k + 3, length)
            a0, a1 = (p0 + 4.0 * p1 + p2) / 6.0, 0.5 * (p2 - p0)
            a2, a3 = 0.5 * (p0 - 2.0 * p1 + p2), (p3 - p0 + 3.0 * (p1 - p2)) / 6.0
            for x in range(c, after):
                t = offset - span + x * scale
                found[x] = depths[x] - np.float32(a0 + t * (a1 + t * (a2 + t * a3)))
            c = after


@compiled
def _leave_out_borders(labels: I32, change: F32) -> None:
    """Make the change of grid pixels with another label around them NaN."""
    height, width = labels.shape
    # One type for all: steps of several are not vectorized.
    same, nan = np.full(width + 2, -1, dtype=np.int32), np.float32(np.nan)
    for r in range(height):
        above, own, below = labels[max(r - 1, 0)], labels[r], labels[min(r + 1, height - 1)]
        line = change[r]
        for c in range(width):
            same[c + 1] = own[c] if (above[c] == own[c]) & (below[c] == own[c]) else np.int32(-1)
        same[0], same[width + 1] = same[1], same[width]
        for c in range(width):
            is_inner = (same[c] == own[c]) & (same[c + 1] == own[c]) & (same[c + 2] == own[c])
            line[c] = line[c] if is_inner else nan


@compiled
def _sum_means(runs: I32, change: F32, sums: F64) -> None:
    """Sum 1, d and dd by label over the changes that count."""
    for n in range(runs.shape[0]):
        r, begin, end, label = runs[n]
        line = change[r]
        count = total = squares = 0.0
        for c in range(begin, end):
            # False for NaN.
            counts = abs(line[c]) < _MOTION_MOST_PER_M
            one, d = (1.0, np.float64(line[c])) if counts else (0.0, 0.0)
            count, total, squares = count + one, total + d, squares + d * d
        own = sums[label]
        own[0], own[1], own[2] = own[0] + count, own[1] + total, own[2] + squares


@compiled
def _sum_moments(runs: I32, inner_change: F32, means: F64, sums: F64) -> None:
    """Sum by label over changes that agree with their mean: 1, x, y, d, xx, yy, xy, xd, yd."""
    for n in range(runs.shape[0]):
        r, begin, end, label = runs[n]
        line, mean, limit = inner_change[r], means[label, 1], means[label, 2]
        count = x = xx = d = xd = 0.0
        for c in range(begin, end):
            beyond, column = np.float64(line[c]) - mean, np.float64(c)
            agrees = (abs(beyond) < limit) & (abs(line[c]) < _MOTION_MOST_PER_M)
            one, beyond = (1.0, beyond) if agrees else (0.0, 0.0)
            count, x, xx = count + one, x + one * column, xx + one * column * column
            d, xd = d + beyond, xd + beyond * column
        own = sums[label]
        for k, each in enumerate((count, x, r * count, d, xx, r * r * count, r * x, xd, r * d)):
            own[k] += each


@compiled
def _grow(
    labels: I32,
    inverse_depth: F32,
    step: int,
    splines: Splines,
    planes: F64,
    limits: F32,
    is_shown: Bool,
    passes: int,
) -> None:
    """Remove some labels; then give unlabeled grid pixels the adjacent one that explains them best."""
    axes, weights, starts = splines
    height, width = labels.shape
    grid_pixels, found = np.empty(labels.size, dtype=np.int64), np.empty(labels.size, dtype=np.int32)
    flat = labels.reshape(-1)
    depths = inverse_depth.reshape(-1)
    waiting = 0
    for pixel in range(flat.size):
        if not is_shown[flat[pixel]]:
            flat[pixel] = 0
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
                if label == 0 or axes[label, 0, 2] == 0.0:
                    continue
                u, v = column * step, row * step
                if not (
                    _reaches((u - axes[label, 0, 0]) * axes[label, 0, 1], axes[label, 0, 2])
                    and _reaches((v - axes[label, 1, 0]) * axes[label, 1, 1], axes[label, 1, 2])
                ):
                    continue
                moved = planes[label, 0] + row * planes[label, 2] + column * planes[label, 1]
                explained = spline_at(axes, weights, starts, label, v, u) + moved
                residual = np.float32(abs(explained - depths[grid_pixels[n]]))
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
