"""Least-squares B-spline fits to values on part of a pixel grid, through separable normal equations."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbsv

from nurbseg.segmentation.bspline import CUBIC, neighbor_products, pixel_basis, pixel_knots
from nurbseg.segmentation.knot_lattice import LatticeBasis

#: Added to the diagonal of the normal matrix, as a share of its largest entry. It decides only what the
#: data leave open: in the limit the solution is the one of least norm.
_RIDGE_SHARE = 1e-10


def fit_control_points(
    values: NDArray[np.floating],
    mask: NDArray[np.bool_],
    counts: tuple[int, int],
    smoothness: float = 0.0,
) -> NDArray[np.float64]:
    """Fit the control points of a bicubic spline to values on part of a window of pixels.

    The parameters are the pixels' places in the window. The normal matrix has an entry for every two
    control points whose functions overlap, a sum over pixels of two basis functions along each axis; such
    sums are two matrix products with the mask in between.

    Parameters
    ----------
    values : (C, h, w) floating
        Images to fit; read only where `mask` is set.
    mask : (h, w) bool
        Pixels that have a value, at least one.
    counts : (int, int)
        Control points along rows' parameter u (columns of the image) and v (rows of the image).
    smoothness : float
        Weight of the squared second differences of the control values along both axes, against the squared
        residuals. Linear functions have none, so that the spline goes on linearly where there is no data.

    Returns
    -------
    (C, nv, nu) float64
        Control values. Each image is fitted about its mean over the mask; where the data leave control
        values open, the solution is the one of least norm about that mean, reached by a vanishing ridge.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the values are not finite, so that there is no solution.
    """
    nu, nv = counts
    height, width = mask.shape
    Bu, Bv = pixel_basis(width, nu), pixel_basis(height, nv)
    weight = mask.astype(np.float64)
    overlaps = neighbor_products(height, nv).T @ (weight @ neighbor_products(width, nu))
    right = np.empty((values.shape[0], nv, nu))
    centers = np.empty((values.shape[0], 1, 1))
    masked = np.zeros(mask.shape)
    ones = Bv.T @ (weight @ Bu)
    points = weight.sum()
    # One image at a time: all of them would not stay in the cache.
    for center, sums, image in zip(centers, right, values, strict=True):
        np.copyto(masked, image, where=mask)
        center[...] = masked.sum() / points
        np.subtract(Bv.T @ (masked @ Bu), center * ones, out=sums)
    if smoothness > 0:
        penalty = smoothness * _second_differences(
            *((width, nu, height, nv) if nu > nv else (height, nv, width, nu))
        )
    else:
        penalty = None
    return _solved(overlaps, right, penalty) + centers


def fit_on_lattice(
    values: NDArray[np.float64],
    mask: NDArray[np.bool_],
    rows: LatticeBasis,
    columns: LatticeBasis,
    smoothness: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit the control values of a bicubic spline on evenly spaced knots to an image on part of a window.

    Parameters
    ----------
    values : (h, w) float64
        Image to fit; finite, read only where `mask` is set.
    mask : (h, w) bool
        Pixels that have a value, at least one.
    rows, columns : LatticeBasis
        Along both axes.
    smoothness : float
        As for `fit_control_points`; more than 0.

    Returns
    -------
    control : (rows.count, columns.count) float64
        Control values.
    held : (rows.count, columns.count) float64
        Sum over the pixels of each basis function's square: by how much they hold its control value.

    Raises
    ------
    numpy.linalg.LinAlgError
        If there is no finite solution.
    """
    weight = mask.astype(np.float64)
    overlaps = rows.products.T @ (weight @ columns.products)
    # About the mean, so that what the data leave open goes there; the basis functions sum to 1.
    centered = np.multiply(values, weight)
    center = centered.sum() / weight.sum()
    centered -= np.multiply(weight, center, out=weight)
    right = rows.values.T @ (centered @ columns.values)
    counts = sorted((rows.count, columns.count), reverse=True)
    penalty = smoothness * _even_second_differences(*counts)
    control: NDArray[np.float64] = _solved(overlaps, right[np.newaxis], penalty)[0]
    control += center
    return control, overlaps[: rows.count, : columns.count]


def _solved(
    overlaps: NDArray[np.float64], right: NDArray[np.float64], penalty: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Solve the normal equations for (C, nv, nu) control values; the penalty is for the longer axis first."""
    # Numbering control points along the direction that has fewer gives the narrower band.
    turned = right.shape[2] > right.shape[1]
    if turned:
        overlaps, right = overlaps.T, right.transpose(0, 2, 1)
    images, outer, inner = right.shape
    band = np.append(overlaps.ravel(), 0.0)[_band_sources(outer, inner)]
    if penalty is not None:
        band += penalty
    band[0] += _RIDGE_SHARE * band[0].max()
    columns = right.reshape(images, outer * inner).T
    _, solution, failed = dpbsv(band, columns, lower=1, overwrite_ab=1)
    if failed or not np.isfinite(solution).all():
        raise LinAlgError("the normal equations have no finite solution")
    control = np.asarray(solution.T.reshape(images, outer, inner), dtype=np.float64)
    return control.transpose(0, 2, 1) if turned else control


@lru_cache(maxsize=256)
def _band_sources(nv: int, nu: int) -> NDArray[np.intp]:
    """Say where each entry of the banded normal matrix stands among the flattened overlap sums.

    Control point (a, b) has number ``a * nu + b``; row d of the lower band holds the entries of numbers
    that are d apart. Control points that do not overlap point at the zero that is appended.
    """
    spread = CUBIC + 1
    zero = (spread * nv) * (spread * nu)
    sources = np.full((min(CUBIC * nu + CUBIC, nv * nu - 1) + 1, nv * nu), zero, dtype=np.intp)
    a, b = np.divmod(np.arange(nv * nu), nu)
    for k in range(min(spread, nv)):
        for step in range(-CUBIC, spread):
            if k == 0 and step < 0:
                continue
            inside = (a + k < nv) & (b + step >= 0) & (b + step < nu)
            row = k * nv + a[inside]
            column = abs(step) * nu + b[inside] + min(step, 0)
            sources[k * nu + step, np.flatnonzero(inside)] = row * (spread * nu) + column
    sources.flags.writeable = False
    return sources


@lru_cache(maxsize=256)
def _second_differences(height: int, nv: int, width: int, nu: int) -> NDArray[np.float64]:
    """Return the quadratic form of the squared second differences of control values, as a lower band.

    A control value belongs to the mean of three successive knots, its Greville abscissa; the differences
    are divided by the distances of these, in units of their mean, so that linear functions have none.
    """
    bends = []
    for size, count in ((height, nv), (width, nu)):
        knots = pixel_knots(size, count)
        place = (knots[1:-3] + knots[2:-2] + knots[3:-1]) / 3
        slopes = np.diff(np.eye(count), axis=0) * (np.diff(place).mean() / np.diff(place))[:, np.newaxis]
        bends.append(np.diff(slopes, axis=0))
    return _penalty_band(*bends)


@lru_cache(maxsize=256)
def _even_second_differences(nv: int, nu: int) -> NDArray[np.float64]:
    """Return the same for evenly spaced knots."""
    return _penalty_band(*(np.diff(np.eye(count), n=2, axis=0) for count in (nv, nu)))


def _penalty_band(bends_v: NDArray[np.float64], bends_u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Add up the squares of (count - 2, count) differences along both axes, as a lower band, read-only."""
    rows, columns = bends_v.T @ bends_v, bends_u.T @ bends_u
    nv, nu = len(rows), len(columns)
    band = np.zeros((min(CUBIC * nu + CUBIC, nv * nu - 1) + 1, nv * nu))
    for apart in range(CUBIC):
        inner = np.append(np.diagonal(columns, apart), np.zeros(apart))
        band[apart] += np.tile(inner, nv)
        outer = np.append(np.diagonal(rows, apart), np.zeros(apart))
        band[apart * nu] += np.repeat(outer, nu)
    band.flags.writeable = False
    return band


__all__ = ["LinAlgError", "fit_control_points", "fit_on_lattice"]
