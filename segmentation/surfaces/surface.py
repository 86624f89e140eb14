"""NURBS surfaces over the image: their points, derivatives and normals, and their fit to a segment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.blas import one_blas_thread
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.points.grid import PixelGrid, full_grid
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.bspline import CUBIC, basis_matrix, pixel_basis, pixel_knots
from nurbseg.segmentation.surfaces.distances import spline_distances
from nurbseg.segmentation.surfaces.leastsquares import LinAlgError, fit_control_points
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS, residual_metrics
from nurbseg.segmentation.surfaces.minimum_norm import minimum_norm_control_points

_FEWEST_CONTROL_POINTS = CUBIC + 1
#: Points evaluated at once away from a lattice, to bound the memory.
_BLOCK = 16_384


@dataclass(frozen=True, slots=True, eq=False)
class NurbsSurface:
    """A non-uniform rational B-spline surface whose parameters are pixels: u = column, v = row (eq. 4).

    Parameters
    ----------
    degree : (int, int)
        Along u and v.
    knots_u : (m + p + 1,) float64
        Knot vector along u, pixels of the full image.
    knots_v : (n + q + 1,) float64
        Knot vector along v, pixels of the full image.
    control_points_m : (n, m, 3) float64
        Control points, metres; the first axis goes with v, the second with u.
    weights : (n, m) float64
        Weight of each control point, more than 0; all 1 for the paper's surfaces.
    window : (int, int, int, int)
        Pixels that the surface spans: first row, first column, and one past the last of each.

    Raises
    ------
    ValueError
        If shapes do not match or a weight is not positive.
    """

    degree: tuple[int, int]
    knots_u: NDArray[np.float64]
    knots_v: NDArray[np.float64]
    control_points_m: NDArray[np.float64]
    weights: NDArray[np.float64]
    window: tuple[int, int, int, int]

    def __post_init__(self) -> None:
        p, q = self.degree
        n, m = self.weights.shape
        if self.control_points_m.shape != (n, m, 3):
            raise ValueError(
                f"control_points_m: expected {(n, m, 3)} as weights, got {self.control_points_m.shape}"
            )
        for name, knots, size in (("knots_u", self.knots_u, m + p + 1), ("knots_v", self.knots_v, n + q + 1)):
            if knots.shape != (size,):
                raise ValueError(f"{name}: expected ({size},) for degree {self.degree}, got {knots.shape}")
        if not (self.weights > 0).all():
            raise ValueError(f"weights: expected positive weights, got {float(self.weights.min())}")
        for array in (self.knots_u, self.knots_v, self.control_points_m, self.weights):
            array.flags.writeable = False


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well one surface explains a segment.

    Parameters
    ----------
    surface : NurbsSurface or None
        The surface; None where there is none.
    residuals_m : (N,) float64
        Distance of each fitted point to the surface at the point's own parameters, metres.
    values : mapping of metric to float
        The deciding metric and the four residual metrics.
    reason : str
        Why there is no surface; empty where there is one.
    pixels : (N,) intp
        The pixels that were fitted, flat indices of the full image: those of the segment, or those of
        them on the grid on which splits are decided.
    floor : float
        What noise alone leaves of the deciding metric, the least that it counts for in the ratio.
    """

    surface: NurbsSurface | None
    residuals_m: NDArray[np.float64]
    values: Mapping[Metric, float]
    reason: str
    pixels: NDArray[np.intp]
    floor: float = 0.0

    def __post_init__(self) -> None:
        self.residuals_m.flags.writeable = False
        self.pixels.flags.writeable = False
        object.__setattr__(self, "values", MappingProxyType(dict(self.values)))


def evaluate(
    surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64], du: int = 0, dv: int = 0
) -> NDArray[np.float64]:
    """Evaluate a surface, or a partial derivative of up to the second order, at scattered parameters.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (N,) float
        Parameters: column and row, pixels. Outside of the knots the polynomials of the ends go on.
    du, dv : int
        Order of the derivative along u and v, together at most 2.

    Returns
    -------
    (N, 3) float64
        Points in metres, or derivatives in metres per pixel to the power of the order.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, eq. 4.11 and 4.20.
    """
    u = np.atleast_1d(np.asarray(u, dtype=np.float64))
    v = np.atleast_1d(np.asarray(v, dtype=np.float64))
    if u.shape != v.shape or u.ndim != 1:
        raise ValueError(f"u, v: expected two (N,) arrays of equal length, got {u.shape} and {v.shape}")
    points = np.empty((u.size, 3))
    for start in range(0, u.size, _BLOCK):
        part = slice(start, start + _BLOCK)
        points[part] = _derivative(_Scattered(surface, u[part], v[part]), du, dv).T
    return points


def evaluate_lattice(
    surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64], du: int = 0, dv: int = 0
) -> NDArray[np.float64]:
    """Evaluate a surface or its derivative wherever one of some rows meets one of some columns.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u : (W,) float
        Columns, pixels.
    v : (H,) float
        Rows, pixels.
    du, dv : int
        Order of the derivative along u and v, together at most 2.

    Returns
    -------
    (H, W, 3) float64
        As `evaluate`.
    """
    return np.moveaxis(_derivative(_Lattice(surface, u, v), du, dv), 0, -1)


def normals(surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit normals of a surface, S_u x S_v, which look away from the camera.

    Parameters
    ----------
    surface : NurbsSurface
        The surface.
    u, v : (N,) float
        Parameters: column and row, pixels.

    Returns
    -------
    (N, 3) float64
        Unit vectors; NaN where the surface has no tangent plane.
    """
    cross = np.cross(evaluate(surface, u, v, 1, 0), evaluate(surface, u, v, 0, 1))
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    unit: NDArray[np.float64] = np.divide(cross, length, out=np.full_like(cross, np.nan), where=length > 0)
    return unit


class _Lattice:
    """The four homogeneous coordinates of a surface on a lattice of parameters, as (H, W) images."""

    def __init__(self, surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        self.surface = surface
        self.u, self.v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)

    def homogeneous(self, net: NDArray[np.float64], du: int, dv: int) -> NDArray[np.float64]:
        Bu = basis_matrix(self.surface.knots_u, self.surface.degree[0], self.u, du)
        Bv = basis_matrix(self.surface.knots_v, self.surface.degree[1], self.v, dv)
        images: NDArray[np.float64] = Bv @ net @ Bu.T
        return images


class _Scattered:
    """The same at scattered parameters, as (N,) arrays."""

    def __init__(self, surface: NurbsSurface, u: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        self.surface, self.u, self.v = surface, u, v

    def homogeneous(self, net: NDArray[np.float64], du: int, dv: int) -> NDArray[np.float64]:
        Bu = basis_matrix(self.surface.knots_u, self.surface.degree[0], self.u, du)
        Bv = basis_matrix(self.surface.knots_v, self.surface.degree[1], self.v, dv)
        values: NDArray[np.float64] = np.einsum("cnk,nk->cn", Bv @ net, Bu)
        return values


def _derivative(places: _Lattice | _Scattered, du: int, dv: int) -> NDArray[np.float64]:
    """Evaluate eq. 4 or its partial derivative: (3, ...) coordinates."""
    if du < 0 or dv < 0 or du + dv > 2:
        raise ValueError(f"du, dv: expected orders of 0 to 2 together, got {du} and {dv}")
    surface = places.surface
    weights = surface.weights
    if (weights == weights[0, 0]).all():
        # Equal weights cancel: the surface is a polynomial spline.
        return places.homogeneous(np.moveaxis(surface.control_points_m, -1, 0), du, dv)
    weighted = surface.control_points_m * weights[..., np.newaxis]
    net = np.concatenate([np.moveaxis(weighted, -1, 0), weights[np.newaxis]])

    def parts(k: int, m: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        homogeneous = places.homogeneous(net, k, m)
        return homogeneous[:3], homogeneous[3]

    A, w = parts(0, 0)
    S = A / w
    if du + dv == 0:
        return S
    if du + dv == 1:
        A1, w1 = parts(du, dv)
        return (A1 - w1 * S) / w
    A11, w11 = parts(du, dv)
    if du == 1:
        (Au, wu), (Av, wv) = parts(1, 0), parts(0, 1)
        Su, Sv = (Au - wu * S) / w, (Av - wv * S) / w
        return (A11 - wu * Sv - wv * Su - w11 * S) / w
    A1, w1 = parts(du // 2, dv // 2)
    S1 = (A1 - w1 * S) / w
    return (A11 - 2.0 * w1 * S1 - w11 * S) / w


def fit_surface(cloud: PointMap, pixels: NDArray[np.intp], config: SegmentationConfig) -> Fit:
    """Fit a NURBS surface to some pixels of a frame (section 3.2).

    Parameters
    ----------
    cloud : PointMap
        The frame.
    pixels : (N,) intp
        Flat indices of the segment's pixels, each of which has a point.
    config : SegmentationConfig
        The number of control points, how they are solved for, and the limits of the metrics.

    Returns
    -------
    Fit
        The surface and how well it fits; without a surface and with a reason where there is nothing to
        fit.

    Raises
    ------
    ValueError
        If a pixel has no point.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, chapter 9.
    """
    if not cloud.valid.reshape(-1)[pixels].all():
        raise ValueError("pixels: expected pixels that have a point")
    ascending = pixels if np.all(pixels[1:] > pixels[:-1]) else np.unique(pixels)
    with one_blas_thread():
        return fit_on_grid(full_grid(cloud), ascending, config)


def fit_on_grid(grid: PixelGrid, places: NDArray[np.intp], config: SegmentationConfig) -> Fit:
    """Fit a surface to some places of a grid, whose step may be larger than a pixel.

    Parameters
    ----------
    grid : PixelGrid
        The points.
    places : (N,) intp
        Flat indices into the grid, ascending.
    config : SegmentationConfig
        As for `fit_surface`.

    Returns
    -------
    Fit
        As of `fit_surface`; parameters and window are pixels of the full image.
    """
    if places.size == 0:
        return Fit(None, np.zeros(0), {}, "0 points, 1 needed", places)
    (top, left, bottom, right), mask = grid.window_mask(places)
    counts = (
        control_point_count(right - left, grid.shape[1], config),
        control_point_count(bottom - top, grid.shape[0], config),
    )
    try:
        solve = minimum_norm_control_points if has_least_norm(config) else fit_control_points
        control = solve(grid.coordinates_m, mask, (top, left), counts)
    except LinAlgError as error:
        return Fit(None, np.zeros(0), {}, f"no least-squares solution: {error}", grid.pixels(places))
    rows, columns = pixel_basis(bottom - top, counts[1]), pixel_basis(right - left, counts[0])
    residuals = spline_distances(control, grid.coordinates_m, mask, (top, left), rows, columns)
    surface = NurbsSurface(
        degree=(CUBIC, CUBIC),
        knots_u=_full_image_knots(right - left, counts[0], left, grid.step),
        knots_v=_full_image_knots(bottom - top, counts[1], top, grid.step),
        control_points_m=np.moveaxis(control, 0, -1),
        weights=np.ones((counts[1], counts[0])),
        window=grid.full_window((top, left, bottom, right)),
    )
    return Fit(surface, residuals, residual_metrics(residuals, config), "", grid.pixels(places))


def has_least_norm(config: SegmentationConfig) -> bool:
    """Say whether fits are the least-squares solutions of least norm, by SVD, and not by a ridge.

    Parameters
    ----------
    config : SegmentationConfig
        Its `least_squares`, and where that is "auto", its metric.

    Returns
    -------
    bool
        Curvature takes second derivatives, which a ridge changes much more than residuals.
    """
    if config.stag15.least_squares == "auto":
        return config.metric in CURVATURE_METRICS
    return config.stag15.least_squares == "svd"


def control_point_count(extent: int, image_extent: int, config: SegmentationConfig) -> int:
    """Return the number of control points for a segment, in proportion to its extent (section 3.2).

    Parameters
    ----------
    extent, image_extent : int
        Of the segment and of the image in one direction, in the same unit.
    config : SegmentationConfig
        Its `control_points_max` belongs to a segment that spans the image; where its `control_points` is
        "fixed", to every segment.

    Returns
    -------
    int
        At least 4, which a cubic needs, and beyond that no more than there are pixels.
    """
    share = 1.0 if config.stag15.control_points == "fixed" else extent / image_extent
    wanted = int(np.floor(config.stag15.control_points_max * share + 0.5))
    return max(_FEWEST_CONTROL_POINTS, min(wanted, extent))


def _full_image_knots(size: int, count: int, first: int, step: int) -> NDArray[np.float64]:
    return (pixel_knots(size, count) + first) * step


__all__ = [
    "Fit",
    "NurbsSurface",
    "control_point_count",
    "evaluate",
    "evaluate_lattice",
    "fit_on_grid",
    "fit_surface",
    "has_least_norm",
    "normals",
]
