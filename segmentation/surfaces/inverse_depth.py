"""Surfaces fitted to inverse depth: rational splines S = ray / d that hold every plane exactly.

With d(u, v) a spline and the ray (x / z, y / z, 1) a polynomial of the pixel, S = ray(u, v) / d(u, v) is a
NURBS surface: its weights are the control values of d, its weighted control points those of the ray. A plane
n . p = 1 has d = n . ray, linear in the pixel. Triangulating sensors measure d, with constant noise.
"""

import math

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, Bool, Intp, compiled, inlined_once
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.points.grid import DepthGrid, Window
from nurbseg.segmentation.points.rays import Rays
from nurbseg.segmentation.surfaces.bspline import CUBIC, SpanBasis, basis_matrices, lattice_basis
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.leastsquares import solve_splines
from nurbseg.segmentation.surfaces.metrics import SQUARE_MOST, residual_metrics
from nurbseg.segmentation.surfaces.surface import unchecked

#: How far the knots of a surface extend beyond its segment, pixels of a 640-wide image.
_MARGIN_PX = 24.0
#: Least inverse depth of a surface where no point supports it, 1/m: weights are positive.
LEAST_PER_M = 1e-2
#: A control value with less support than this may be changed without harm to the fit.
_SUPPORTED = 1.0
#: Factors on the smoothness, tried in turn where a surface would pass through infinity beyond its points: the
#: first with the margin, those after it with one grid pixel.
_STIFFER = (1.0, 1.0, 1e2, 1e4)


def fit_window(
    grid: DepthGrid,
    window: Window,
    mask: NDArray[np.bool_],
    config: SegmentationConfig,
    *,
    floor: float = 0.0,
) -> Fit:
    """Fit a surface to the marked pixels of a window of the grid.

    Parameters
    ----------
    grid : DepthGrid
        The points.
    window : (int, int, int, int)
        First row and column of the grid, and one past the last of each.
    mask : (h, w) bool
        Pixels of the window to fit, at least one, each of which has a point.
    config : SegmentationConfig
        Knot spacing and smoothness.
    floor : float
        Floor of the deciding metric.

    Returns
    -------
    Fit
        The surface, residuals in space and metrics, parameters being pixels of the full image.

    References
    ----------
    .. [1] P. Eilers and B. Marx, "Flexible smoothing with B-splines and penalties", Statistical Science
       11(2), 1996.
    """
    mask = np.ascontiguousarray(mask)
    spacing, smoothness = knots_on(grid, config)
    square_most = SQUARE_MOST * config.extended.inverse_depth_noise**2
    margin = math.ceil(_MARGIN_PX * grid.unit_px / grid.step)
    for stiffer in _STIFFER:
        pixels, solved, positive, (nv, nu), values, square = fit_inverse_depth(
            grid.inverse_depth[np.newaxis],
            grid.distances_m,
            mask,
            window[:2],
            grid.image_shape[1],
            grid.step,
            margin,
            spacing,
            stiffer * smoothness,
            square_most,
            (grid.rays.coefficients, *grid.rays.center, grid.rays.scale),
        )
        if positive or not solved:
            break
        margin = 1
    if not solved:
        reason = "no least-squares solution: the normal equations have no finite solution"
        return Fit(None, np.zeros(0), {}, reason, pixels)
    net, u, v = nv * nu, 4 * nv * nu + nu + 4, 4 * nv * nu + nu + nv + 8
    if not grid.rays.linear:
        rays = ray_control_values(grid.rays, values[4 * net : u], values[u:v])
        values[net : 4 * net] = _divided(rays, values[:net].reshape(nv, nu)).ravel()
    metrics = residual_metrics(values[v:], config)
    values.setflags(write=False)
    weights, points_m = values[:net].reshape(nv, nu), values[net : 4 * net].reshape(nv, nu, 3)
    knots = values[4 * net : u], values[u:v]
    surface = unchecked((CUBIC, CUBIC), *knots, points_m, weights, grid.full_window(window))
    rms_per_m = math.sqrt(square / max(pixels.size, 1))
    return Fit(surface, values[v:], metrics, "", pixels, floor, rms_per_m)


def knots_on(grid: DepthGrid, config: SegmentationConfig) -> tuple[float, float]:
    """Return the knot spacing, grid pixels, and the weight of second differences on the grid."""
    return (
        config.extended.knot_spacing_px * grid.unit_px / grid.step,
        config.extended.smoothness * (2.0 * grid.unit_px / grid.step) ** 2,
    )


@compiled
def fit_inverse_depth(
    images: F32,
    distances_m: F32,
    mask: Bool,
    corner: tuple[int, int],
    image_width: int,
    step: int,
    margin: int,
    spacing: float,
    smoothness: float,
    square_most: float,
    rays: tuple[F64, float, float, float],
) -> tuple[Intp, bool, bool, tuple[int, int], F64, float]:
    """Fit a spline to the inverse depth of the marked grid pixels, and raise control values to the least.

    Returns the marked pixels, flat in the image; whether there is a solution, without which the rest means
    nothing; whether it is positive where points hold it; the numbers of control values along rows and
    columns; in one array, as each that is returned costs a call of Python, the control values, the control
    points if rays are linear, the knots along columns and rows, pixels, and the distances at the marked grid
    pixels, meters; and the sum of the squared residuals of inverse depth, each limited, 1/m^2. Rays are given
    by their coefficients, both coordinates of the center, and the scale.
    """
    rows, knots_v = lattice_basis(corner[0], corner[0] + mask.shape[0], margin, spacing)
    columns, knots_u = lattice_basis(corner[1], corner[1] + mask.shape[1], margin, spacing)
    solved, controls, held = solve_splines(images, mask, corner, rows, columns, smoothness)
    control = controls[0]
    positive = True
    for a in range(rows.size):
        for b in range(columns.size):
            positive &= control[a, b] > LEAST_PER_M or held[a, b] <= _SUPPORTED
            control[a, b] = max(control[a, b], LEAST_PER_M)
    pixels, residuals_m, squares = _residuals(
        images[0], distances_m, mask, corner, image_width, step, control, rows, columns, square_most
    )
    for knots in (knots_u, knots_v):
        for k in range(knots.size):
            knots[k] *= step
    points_m = _divided(_linear_control_values(*rays, knots_u, knots_v), control)
    values = np.concatenate((control.ravel(), points_m.ravel(), knots_u, knots_v, residuals_m))
    return pixels, solved, positive, control.shape, values, squares


@inlined_once
def _residuals(
    inverse_depth: F32,
    distances_m: F32,
    mask: Bool,
    corner: tuple[int, int],
    image_width: int,
    step: int,
    control: F64,
    rows: SpanBasis,
    columns: SpanBasis,
    square_most: float,
) -> tuple[Intp, F64, float]:
    """Return marked pixels, a spline's distances from their points, and the sum of its limited squares."""
    top, left, (height, width) = np.uint32(corner[0]), np.uint32(corner[1]), mask.shape
    count = 0
    for y in range(height):
        for x in range(width):
            count += mask[y, x]
    pixels, residuals_m = np.empty(count, dtype=np.intp), np.empty(count)
    along = np.empty(control.shape[1])
    n, squares = 0, 0.0
    for y in range(height):
        first = rows.starts[y]
        for k in range(along.size):
            along[k] = 0.0
            for i in range(4):
                along[k] += rows.values[y, i] * control[first + i, k]
        for x in range(width):
            if mask[y, x]:
                start = np.uint32(columns.starts[x])
                fitted = 0.0
                for j in range(4):
                    fitted += columns.values[x, j] * along[start + j]
                residual = fitted - inverse_depth[top + y, left + x]
                squares += min(residual * residual, square_most)
                # Both points lie on one ray.
                pixels[n] = ((top + y) * image_width + left + x) * step
                residuals_m[n] = abs(residual) * distances_m[top + y, left + x] / fitted
                n += 1
    return pixels, residuals_m, squares


@compiled
def _divided(rays: F64, control_per_m: F64) -> F64:
    """Return the control points of x / z, y / z and inverse depths."""
    points_m = np.empty((*control_per_m.shape, 3))
    for row in range(control_per_m.shape[0]):
        for column in range(control_per_m.shape[1]):
            for axis in range(2):
                points_m[row, column, axis] = rays[axis, row, column] / control_per_m[row, column]
            points_m[row, column, 2] = 1.0 / control_per_m[row, column]
    return points_m


def ray_control_values(
    rays: Rays, knots_u: NDArray[np.float64], knots_v: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the control values of cubic splines that interpolate the rays.

    Parameters
    ----------
    rays : Rays
        Of the camera.
    knots_u, knots_v : (m + 4,), (n + 4,) float64
        Knot vectors, pixels.

    Returns
    -------
    (2, n, m) float64
        Of x / z and y / z. The splines agree with the rays at the Greville abscissae, the means of three
        successive knots: exactly if the rays are linear, else to the fourth order in the knot spacing.

    References
    ----------
    .. [1] C. de Boor, "A Practical Guide to Splines", 1978, chapter 13.
    """
    u, take_u = _interpolator(knots_u)
    v, take_v = _interpolator(knots_v)
    return np.stack([take_v @ each @ take_u.T for each in rays.at(u, v[:, np.newaxis])])


@compiled
def _linear_control_values(
    coefficients: F64, center_u: float, center_v: float, scale: float, knots_u: F64, knots_v: F64
) -> F64:
    """Return the control values of linear rays: their values at the Greville abscissae."""
    height, width = knots_v.size - 4, knots_u.size - 4
    values = np.empty((2, height, width))
    for row in range(height):
        t = ((knots_v[row + 1] + knots_v[row + 2] + knots_v[row + 3]) / 3.0 - center_v) / scale
        for column in range(width):
            s = ((knots_u[column + 1] + knots_u[column + 2] + knots_u[column + 3]) / 3.0 - center_u) / scale
            for k in range(2):
                values[k, row, column] = (
                    coefficients[k, 0, 0] + coefficients[k, 1, 0] * s + coefficients[k, 0, 1] * t
                )
    return values


def _interpolator(knots: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Greville abscissae of a knot vector, and the matrix from values there to control values."""
    abscissae = np.asarray(knots[1:-3] + knots[2:-2] + knots[3:-1], dtype=np.float64) / 3.0
    return abscissae, np.asarray(np.linalg.inv(basis_matrices(knots, CUBIC, abscissae)[0]), dtype=np.float64)
