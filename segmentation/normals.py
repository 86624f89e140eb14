"""Surface normals of every point, by planes fitted to inverse depth around it."""

from __future__ import annotations

from itertools import product
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.rays import Rays

#: A window needs points on this share of its places to have a plane of its own.
_FILLED_SHARE = 0.3
#: A neighbour's plane is preferred where its variance is below this share of the pixel's own.
_PREFERENCE = 1.0 / 1.5
#: A plane explains a pixel that lies within this many standard deviations of it.
_OWN_DEVIATIONS = 4.0
_UNUSABLE = np.float32(1e3)
_Float = TypeVar("_Float", np.float32, np.float64)


def facet_slopes(
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    *,
    window: int,
    noise_per_m: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Fit a plane of inverse depth around every point, without mixing what lies on both sides of an edge.

    A plane is fitted in the window around each place, from sums over the window. A point then takes, of
    nine windows that hold it, the plane with the least residual among those that explain the point: next to
    an edge that is one which does not reach across [1]_.

    Parameters
    ----------
    inverse_depth : (h, w) float32
        One over depth, 1/m; read only where `valid`.
    valid : (h, w) bool
        Where there is a point.
    window : int
        Side of the windows, places; odd.
    noise_per_m : float
        Standard deviation of the inverse depth, 1/m.

    Returns
    -------
    slope_u, slope_v : (h, w) float32
        Change of inverse depth from one place to the next along columns and rows, 1/m.
    smoothed : (h, w) float32
        Inverse depth of the plane at the point, 1/m.

    References
    ----------
    .. [1] R. M. Haralick and L. Watson, "A facet model for image data", Computer Graphics and Image
       Processing 15(2), 1981.
    """
    height, width = valid.shape
    if not valid.any():
        zeros = np.zeros((height, width), dtype=np.float32)
        return zeros, zeros.copy(), zeros.copy()
    mask = valid.astype(np.float32)
    u = np.arange(width, dtype=np.float32)[np.newaxis] - np.float32(width / 2)
    v = np.arange(height, dtype=np.float32)[:, np.newaxis] - np.float32(height / 2)
    offset = np.float32(inverse_depth[valid].mean(dtype=np.float64))
    d = np.where(valid, inverse_depth - offset, np.float32(0.0))

    def total(image: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(
            cv2.boxFilter(image, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )

    # Central moments of place and inverse depth in each window.
    mu, mv, du, dv = mask * u, mask * v, d * u, d * v
    n = np.maximum(total(mask), 1.0)
    mean_u, mean_v, mean_d = total(mu) / n, total(mv) / n, total(d) / n
    suu = total(mu * u) - n * mean_u * mean_u
    svv = total(mv * v) - n * mean_v * mean_v
    suv = total(mu * v) - n * mean_u * mean_v
    sud = total(du) - n * mean_u * mean_d
    svd = total(dv) - n * mean_v * mean_d
    sdd = total(d * d) - n * mean_d * mean_d
    # A little more variance of place than there is keeps a window of one row or column finite.
    suu += 1e-2 * n
    svv += 1e-2 * n
    determinant = suu * svv - suv * suv
    slope_u = (svv * sud - suv * svd) / determinant
    slope_v = (suu * svd - suv * sud) / determinant
    variance = np.maximum(sdd - slope_u * sud - slope_v * svd, 0.0) / np.maximum(n - 3.0, 1.0)
    # Where all windows fit within rounding, the fuller one is better.
    cost = (variance + np.float32((0.3 * noise_per_m) ** 2)) * (0.5 + 0.5 * window**2 / n)
    cost[n < _FILLED_SHARE * window**2] = _UNUSABLE
    constant = mean_d - slope_u * mean_u - slope_v * mean_v

    best = cost * np.float32(_PREFERENCE)
    chosen = [each.astype(np.float32) for each in (constant, slope_u, slope_v)]
    reach = window // 2
    far = np.float32((_OWN_DEVIATIONS * noise_per_m) ** 2)
    for shift_v, shift_u in product((-reach, 0, reach), repeat=2):
        if shift_u == 0 and shift_v == 0:
            continue
        rows, rows_at = _shifted(shift_v, height)
        columns, columns_at = _shifted(shift_u, width)
        here, there = (rows, columns), (rows_at, columns_at)
        planes = [each[there] for each in (constant, slope_u, slope_v)]
        own = d[here] - planes[0] - planes[1] * u[:, columns] - planes[2] * v[rows]
        own *= own
        candidate = np.where(own > far, _UNUSABLE, cost[there])
        better = candidate < best[here]
        np.copyto(best[here], candidate, where=better)
        for target, plane in zip(chosen, planes, strict=True):
            np.copyto(target[here], plane, where=better)
    constant_best, u_best, v_best = chosen
    smoothed = np.where(valid, constant_best + u_best * u + v_best * v + offset, np.float32(0.0))
    return u_best, v_best, smoothed


def _shifted(shift: int, size: int) -> tuple[slice, slice]:
    """Places along an axis, and the places `shift` farther on, for those where both are on the image."""
    return (
        slice(max(-shift, 0), size - max(shift, 0)),
        slice(max(shift, 0), size - max(-shift, 0)),
    )


def normals_from_slopes(
    slope_u: NDArray[_Float],
    slope_v: NDArray[_Float],
    inverse_depth: NDArray[_Float],
    ray_x: NDArray[_Float],
    ray_y: NDArray[_Float],
    focal_px: tuple[float, float],
) -> NDArray[_Float]:
    """Turn slopes of inverse depth into unit normals.

    The plane n . p = 1 is seen as inverse depth n . (ray_x, ray_y, 1), so that n is the slope times the
    focal length along u and v, and what is left of the inverse depth along z.

    Parameters
    ----------
    slope_u, slope_v : (...) floating
        Change of inverse depth by one pixel, 1/m.
    inverse_depth : (...) floating
        One over depth, 1/m.
    ray_x, ray_y : (...) floating
        Directions x / z and y / z of the pixels.
    focal_px : (float, float)
        Focal lengths along u and v, pixels.

    Returns
    -------
    (..., 3) floating
        Unit vectors towards the camera; 0 where the slopes and inverse depth are 0.
    """
    nx, ny = slope_u * focal_px[0], slope_v * focal_px[1]
    nz = inverse_depth - nx * ray_x - ny * ray_y
    towards = -1.0 / np.maximum(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    normals: NDArray[_Float] = np.empty((*inverse_depth.shape, 3), dtype=inverse_depth.dtype)
    for axis, along in enumerate((nx, ny, nz)):
        np.multiply(along, towards, out=normals[..., axis])
    return normals


def facet_normals(
    inverse_depth: NDArray[np.float32],
    valid: NDArray[np.bool_],
    rays: Rays,
    *,
    step: int,
    window: int,
    noise_per_m: float,
) -> NDArray[np.float32]:
    """Return the unit normal of every point of a grid.

    Parameters
    ----------
    inverse_depth, valid : (h, w) float32 and bool
        One over depth, 1/m, and where there is a point, on every `step`-th row and column of the image.
    rays : Rays
        Of the camera.
    step : int
        Pixels from one place of the grid to the next.
    window : int
        Side of the windows, places.
    noise_per_m : float
        Standard deviation of the inverse depth, 1/m.

    Returns
    -------
    (h, w, 3) float32
        Unit vectors towards the camera; 0 where there is no point.
    """
    height, width = valid.shape
    if not valid.any():
        return np.zeros((height, width, 3), dtype=np.float32)
    slope_u, slope_v, smoothed = facet_slopes(inverse_depth, valid, window=window, noise_per_m=noise_per_m)
    columns = np.arange(width, dtype=np.float64) * step
    rows = np.arange(height, dtype=np.float64) * step
    ray_x, ray_y = rays.lattice(columns, rows)
    normals = normals_from_slopes(
        slope_u / np.float32(step),
        slope_v / np.float32(step),
        smoothed,
        ray_x.astype(np.float32),
        ray_y.astype(np.float32),
        rays.focal_px,
    )
    normals[~valid] = 0.0
    return normals


__all__ = ["facet_normals", "facet_slopes", "normals_from_slopes"]
