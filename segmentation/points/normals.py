"""Surface normals by planes fitted to the inverse depth around each point."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, Bool, compiled, inlined_once
from nurbseg.segmentation.config import OUTLIER_DEVIATIONS
from nurbseg.segmentation.points.rays import Rays

#: Least share of a window's pixels with points for fitting a plane.
_FILLED_SHARE = 0.3
#: A neighbor's plane is preferred where its variance is below this share of the pixel's own.
_PREFERENCE = np.float32(1.0 / 1.5)
#: Stands for the variance where there are too few points for a plane.
_UNUSABLE = np.float32(1e3)
#: Where the nine windows that hold a pixel are centered, in reaches from it.
_DOWN, _ACROSS = np.indices((3, 3)).reshape(2, -1) - 1
#: Number of the one around the pixel itself.
_OWN = 4


def facet_slopes(
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    *,
    window: int,
    noise_per_m: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Fit a plane of inverse depth around every point, without mixing both sides of an edge.

    A plane is fitted in the window around each grid pixel. A point then takes, of nine windows that hold it,
    the plane with the least residual among those that explain the point: next to an edge, one that does not
    reach across it [1]_.

    Parameters
    ----------
    inverse_depth : (h, w) float32
        One over depth, 1/m; read only where `valid`.
    valid : (h, w) bool
        Where there is a point.
    window : int
        Side of the windows, grid pixels; odd.
    noise_per_m : float
        Standard deviation of the inverse depth, 1/m.

    Returns
    -------
    slope_u, slope_v : (h, w) float32
        Change of inverse depth from one grid pixel to the next along columns and rows, 1/m.
    smoothed : (h, w) float32
        Inverse depth of the plane at the point, 1/m.

    References
    ----------
    .. [1] R. M. Haralick and L. Watson, "A facet model for image data", Computer Graphics and Image
       Processing 15(2), 1981.
    """
    inverse_depth, valid = np.ascontiguousarray(inverse_depth), np.ascontiguousarray(valid)
    planes, cost = _window_planes(inverse_depth, valid, window, noise_per_m)
    chosen = _chosen_planes(inverse_depth, valid, planes, cost, window // 2, OUTLIER_DEVIATIONS * noise_per_m)
    smoothed, slope_u, slope_v = chosen
    return slope_u, slope_v, smoothed


@compiled
def _window_planes(inverse_depth: F32, valid: Bool, window: int, noise_per_m: float) -> tuple[F32, F32]:
    """Fit planes from running sums over windows: (3, h, w) value at the pixel and slopes; (h, w) cost."""
    height, width = valid.shape
    half = window // 2
    planes = np.empty((3, height, width), dtype=np.float32)
    cost = np.empty((height, width), dtype=np.float32)
    # Sums over the rows of a window, of 1, v, v^2, d, d v, d^2 at each column.
    below = np.zeros((6, width))
    sums, row = np.empty((10, width)), np.empty((4, width))
    least = (0.3 * noise_per_m) ** 2
    full = float(window * window)
    offset = _mean(inverse_depth, valid)
    for entering in range(height + half):
        if entering < height:
            _add_row(below, inverse_depth[entering], valid[entering], offset, float(entering), 1.0)
        if entering >= window:
            leaving = entering - window
            _add_row(below, inverse_depth[leaving], valid[leaving], offset, float(leaving), -1.0)
        y = entering - half
        if y < 0:
            continue
        _add_columns(below, half, sums)
        _planes_of_row(sums, float(y), full, least, row)
        for x in range(width):
            planes[0, y, x], planes[1, y, x], planes[2, y, x] = row[0, x] + offset, row[1, x], row[2, x]
            cost[y, x] = row[3, x]
    return planes, cost


@compiled
def _planes_of_row(sums: F64, y: float, full: float, least: float, row: F64) -> None:
    """Fit a plane in each window: its value at the pixel, its slopes and its cost.

    A function of its own, as only few arrays in a loop are found not to overlap, so that it is vectorized.
    """
    for x in range(row.shape[1]):
        n = max(sums[0, x], 1.0)
        mean_u, mean_v, mean_d = sums[6, x] / n - x, sums[1, x] / n - y, sums[3, x] / n
        # Added variance keeps the plane of a single row or column finite.
        suu = sums[7, x] - n * (mean_u + x) * (mean_u + x) + 1e-2 * n
        svv = sums[2, x] - n * (mean_v + y) * (mean_v + y) + 1e-2 * n
        suv = sums[8, x] - n * (mean_u + x) * (mean_v + y)
        sud = sums[9, x] - n * (mean_u + x) * mean_d
        svd = sums[4, x] - n * (mean_v + y) * mean_d
        sdd = sums[5, x] - n * mean_d * mean_d
        per_determinant = 1.0 / (suu * svv - suv * suv)
        slope_u = (svv * sud - suv * svd) * per_determinant
        slope_v = (suu * svd - suv * sud) * per_determinant
        variance = max(sdd - slope_u * sud - slope_v * svd, 0.0) / max(n - 3.0, 1.0)
        # Where all windows fit within rounding, the fuller one is better.
        price = (variance + least) * (0.5 + 0.5 * full / n)
        row[0, x], row[1, x], row[2, x] = mean_d - slope_u * mean_u - slope_v * mean_v, slope_u, slope_v
        row[3, x] = price if n >= _FILLED_SHARE * full else _UNUSABLE


@inlined_once
def _mean(inverse_depth: F32, valid: Bool) -> float:
    total, count = 0.0, 0
    for y in range(valid.shape[0]):
        for x in range(valid.shape[1]):
            total += np.float64(inverse_depth[y, x]) if valid[y, x] else 0.0
            count += valid[y, x]
    return total / max(count, 1)


@compiled
def _add_row(below: F64, inverse_depth: F32, valid: Bool, offset: float, v: float, sign: float) -> None:
    """Add a row of points to the sums at each column, or take it away."""
    for x in range(valid.size):
        one = sign if valid[x] else 0.0
        d = np.float64(inverse_depth[x]) - offset if valid[x] else 0.0
        below[0, x] += one
        below[1, x] += one * v
        below[2, x] += one * v * v
        below[3, x] += sign * d
        below[4, x] += sign * d * v
        below[5, x] += sign * d * d


@inlined_once
def _add_columns(below: F64, half: int, sums: F64) -> None:
    """Add up columns in windows: of 1, v, v^2, d, d v, d^2 and, with u, of u, u^2, u v, d u."""
    width = below.shape[1]
    n, nv, nvv, nd, ndv, ndd, nu, nuu, nuv, ndu = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for entering in range(width + half):
        if entering < width:
            u = float(entering)
            one, v, d = below[0, entering], below[1, entering], below[3, entering]
            n, nv, nvv, nd = n + one, nv + v, nvv + below[2, entering], nd + d
            ndv, ndd = ndv + below[4, entering], ndd + below[5, entering]
            nu, nuu, nuv, ndu = nu + u * one, nuu + u * u * one, nuv + u * v, ndu + u * d
        leaving = entering - 2 * half - 1
        if leaving >= 0:
            u = float(leaving)
            one, v, d = below[0, leaving], below[1, leaving], below[3, leaving]
            n, nv, nvv, nd = n - one, nv - v, nvv - below[2, leaving], nd - d
            ndv, ndd = ndv - below[4, leaving], ndd - below[5, leaving]
            nu, nuu, nuv, ndu = nu - u * one, nuu - u * u * one, nuv - u * v, ndu - u * d
        x = entering - half
        if x >= 0:
            sums[0, x], sums[1, x], sums[2, x], sums[3, x], sums[4, x] = n, nv, nvv, nd, ndv
            sums[5, x], sums[6, x], sums[7, x], sums[8, x], sums[9, x] = ndd, nu, nuu, nuv, ndu


@compiled
def _chosen_planes(
    inverse_depth: F32, valid: Bool, planes: F32, cost: F32, reach: int, own_per_m: float
) -> F32:
    """Give each grid pixel the best plane of nine windows that hold it: (3, h, w) value there and slopes."""
    height, width = valid.shape
    chosen = np.empty_like(planes)
    best, number = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.int32)
    far = np.float32(own_per_m)
    for y in range(height):
        depth = inverse_depth[y]
        for x in range(width):
            best[x], number[x] = cost[y, x] * _PREFERENCE, _OWN
        for n in range(9):
            shift_v, shift_u = _DOWN[n] * reach, _ACROSS[n] * reach
            if n == _OWN or not 0 <= y + shift_v < height:
                continue
            begin, end = max(0, -shift_u), width - max(0, shift_u)
            there = slice(begin + shift_u, end + shift_u)
            price = cost[y + shift_v, there]
            at, along_u = planes[0, y + shift_v, there], planes[1, y + shift_v, there]
            along_v = planes[2, y + shift_v, there]
            du, dv = np.float32(shift_u), np.float32(shift_v)
            for k in range(end - begin):
                x = begin + k
                plane = at[k] - along_u[k] * du - along_v[k] * dv
                better = (price[k] < best[x]) & (abs(depth[x] - plane) <= far)
                best[x] = price[k] if better else best[x]
                number[x] = n if better else number[x]
        for x in range(width):
            shift_v, shift_u = _DOWN[number[x]] * reach, _ACROSS[number[x]] * reach
            row, column = y + shift_v, x + shift_u
            slope_u, slope_v = planes[1, row, column], planes[2, row, column]
            value = planes[0, row, column] - slope_u * np.float32(shift_u) - slope_v * np.float32(shift_v)
            chosen[0, y, x] = value if valid[y, x] else np.float32(0.0)
            chosen[1, y, x], chosen[2, y, x] = slope_u, slope_v
    return chosen


def facet_normals(
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    rays: Rays,
    *,
    step: int,
    window: int,
    noise_per_m: float,
    box: tuple[slice, slice] = (slice(0, None), slice(0, None)),
) -> NDArray[np.float32]:
    """Return the unit normal of every point of a grid, or of a part of it.

    Parameters
    ----------
    inverse_depth, valid : (h, w) float32 and bool
        One over depth, 1/m, and where there is a point, on every `step`-th row and column of the image.
    rays : Rays
        Of the camera.
    step : int
        Pixels from one grid pixel to the next.
    window : int
        Side of the windows, grid pixels.
    noise_per_m : float
        Standard deviation of the inverse depth, 1/m.
    box : (slice, slice)
        Rows and columns of the part.

    Returns
    -------
    (h, w, 3) float32
        Unit vectors toward the camera; 0 where there is no point.
    """
    # A point takes a window whose center is half of one away, and which extends as far again.
    reach, (fx, fy) = 2 * (window // 2), rays.focal_px
    ranges = [part.indices(size)[:2] for part, size in zip(box, valid.shape, strict=True)]
    around = tuple(slice(max(begin - reach, 0), end + reach) for begin, end in ranges)
    inner = tuple(slice(min(begin, reach), min(begin, reach) + end - begin) for begin, end in ranges)
    slope_u, slope_v, smoothed = (
        each[inner]
        for each in facet_slopes(inverse_depth[around], valid[around], window=window, noise_per_m=noise_per_m)
    )
    ray_x, ray_y = _rays_on_grid(rays, *valid.shape, step)
    return plane_normals(smoothed, slope_u, slope_v, ray_x[box], ray_y[box], (fx / step, fy / step))


@lru_cache(maxsize=2)
def _rays_on_grid(rays: Rays, height: int, width: int, step: int) -> tuple[F64, F64]:
    """Return x / z and y / z of every grid pixel: the same in all frames of a camera."""
    columns, rows = np.arange(width, dtype=np.float64) * step, np.arange(height, dtype=np.float64) * step
    return rays.at(columns, rows[:, np.newaxis])


def plane_normals(
    inverse_depth: NDArray[Any],
    slope_u: NDArray[Any],
    slope_v: NDArray[Any],
    ray_x: NDArray[np.float64],
    ray_y: NDArray[np.float64],
    focal_px: tuple[float, float],
) -> NDArray[Any]:
    """Return the unit normals of planes of inverse depth.

    The plane n . p = 1 has the inverse depth n . (ray_x, ray_y, 1). So n is the slope times the focal length
    along u and v, and along z what remains of the inverse depth.

    Parameters
    ----------
    inverse_depth, slope_u, slope_v : (...) float32 or float64
        At some pixels, 1/m, and its change from pixel to pixel along rows and along columns.
    ray_x, ray_y : (...) float64
        x / z and y / z of the pixels' rays.
    focal_px : (float, float)
        Focal lengths in the pixels of the slopes.

    Returns
    -------
    (..., 3) float32 or float64
        Unit vectors toward the camera; 0 where the inverse depth is 0.
    """
    normals = np.empty((*inverse_depth.shape, 3), dtype=inverse_depth.dtype)
    slopes, rays = (slope_u.ravel(), slope_v.ravel()), (ray_x.ravel(), ray_y.ravel())
    _normals(inverse_depth.ravel(), *slopes, *rays, *focal_px, normals.reshape(-1, 3))
    return normals


@compiled
def _normals(
    inverse_depth: NDArray[Any],
    slope_u: NDArray[Any],
    slope_v: NDArray[Any],
    ray_x: F64,
    ray_y: F64,
    fx: float,
    fy: float,
    normals: NDArray[Any],
) -> None:
    for n in range(inverse_depth.size):
        nx, ny = slope_u[n] * fx, slope_v[n] * fy
        nz = inverse_depth[n] - nx * ray_x[n] - ny * ray_y[n]
        towards = -1.0 / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
        towards = towards if inverse_depth[n] != 0.0 else 0.0
        normals[n, 0], normals[n, 1], normals[n, 2] = nx * towards, ny * towards, nz * towards
