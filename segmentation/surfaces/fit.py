"""The paper's fit of a surface to a segment, and how well a surface explains one."""

import copyreg
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, Bool, compiled
from nurbseg.common.computer import one_blas_thread
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.points.grid import PixelGrid, decimated_grid
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.surfaces.bspline import CUBIC, SpanBasis, pixel_basis, pixel_knots
from nurbseg.segmentation.surfaces.leastsquares import fit_control_points, span_edges
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS, residual_metrics
from nurbseg.segmentation.surfaces.surface import NurbsSurface


def _frozen(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


# Results contain read-only mappings, which Python cannot pickle.
copyreg.pickle(MappingProxyType, lambda values: (_frozen, (dict(values),)))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well one surface explains a segment.

    Parameters
    ----------
    surface : NurbsSurface or None
        The surface, if there is one.
    residuals_m : (N,) float64
        Distance of each fitted point to the surface at the point's own parameters, meters.
    values : mapping of metric to float
        The deciding metric and the four residual metrics.
    reason : str
        Why there is no surface; empty if there is one.
    pixels : (N,) intp
        Flat indices of the fitted pixels in the full image; only those on the grid, if there is one.
    floor : float
        Value of the deciding metric that noise alone explains, the least it counts for in the ratio.
    rms_per_m : float
        Root mean square residual of inverse depth, 1/m, each limited to four times the noise; 0 where inverse
        depth was not fitted.
    """

    surface: NurbsSurface | None
    residuals_m: NDArray[np.float64]
    values: Mapping[Metric, float]
    reason: str
    pixels: NDArray[np.intp]
    floor: float = 0.0
    rms_per_m: float = 0.0

    def __post_init__(self) -> None:
        self.residuals_m.setflags(write=False)
        self.pixels.setflags(write=False)
        if not isinstance(self.values, MappingProxyType):
            object.__setattr__(self, "values", MappingProxyType(dict(self.values)))

    def value(self, metric: Metric) -> float:
        """Return what a metric counts as in the ratio (eq. 5): at least the floor; 0 if not measured."""
        return max(self.values.get(metric, 0.0), self.floor)


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
        The surface and how well it fits; without a surface, but with a reason, if there is nothing to fit.

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
    # Ascending, much faster than by NumPy's `unique`.
    chosen = np.zeros(cloud.valid.size, dtype=bool)
    chosen[pixels] = True
    with one_blas_thread():
        return fit_on_grid(decimated_grid(cloud, 1), np.flatnonzero(chosen), config)


def fit_on_grid(grid: PixelGrid, grid_pixels: NDArray[np.intp], config: SegmentationConfig) -> Fit:
    """Fit a surface to some pixels of a grid, whose step may be larger than a pixel.

    Parameters
    ----------
    grid, config : PixelGrid, SegmentationConfig
        The points; and the settings, as for `fit_surface`.
    grid_pixels : (N,) intp
        Flat indices into the grid, ascending.

    Returns
    -------
    Fit
        As of `fit_surface`; parameters and window are pixels of the full image.
    """
    if grid_pixels.size == 0:
        return Fit(None, np.zeros(0), {}, "0 points, 1 needed", grid_pixels)
    (top, left, bottom, right), mask = grid.window_mask(grid_pixels)
    counts = (
        control_point_count(right - left, grid.shape[1], config),
        control_point_count(bottom - top, grid.shape[0], config),
    )
    solver = config.stag15.least_squares
    if solver == "auto":
        # Curvature takes second derivatives, which a ridge changes much more than residuals.
        solver = "svd" if config.metric in CURVATURE_METRICS else "ridge"
    if solver == "svd":
        from nurbseg.segmentation.surfaces.minimum_norm import minimum_norm_control_points as solve
    else:
        solve = fit_control_points
    try:
        control = solve(grid.coordinates_m, mask, (top, left), counts)
    except LinAlgError as error:
        return Fit(None, np.zeros(0), {}, f"no least-squares solution: {error}", grid.pixels(grid_pixels))
    rows, columns = pixel_basis(bottom - top, counts[1]), pixel_basis(right - left, counts[0])
    residuals = _distances(grid.coordinates_m, mask, (top, left), control, rows, columns)
    surface = NurbsSurface(
        degree=(CUBIC, CUBIC),
        knots_u=(pixel_knots(right - left, counts[0]) + left) * grid.step,
        knots_v=(pixel_knots(bottom - top, counts[1]) + top) * grid.step,
        control_points_m=np.moveaxis(control, 0, -1),
        weights=np.ones((counts[1], counts[0])),
        window=grid.full_window((top, left, bottom, right)),
    )
    return Fit(surface, residuals, residual_metrics(residuals, config), "", grid.pixels(grid_pixels))


def control_point_count(extent: int, image_extent: int, config: SegmentationConfig) -> int:
    """Return the number of control points for a segment, in proportion to its extent (section 3.2).

    Parameters
    ----------
    extent, image_extent : int
        Of the segment and of the image in one direction, in the same unit.
    config : SegmentationConfig
        Its `control_points_max` is for a segment that spans the image or, if its `control_points` is "fixed",
        for every segment.

    Returns
    -------
    int
        At least 4, which a cubic needs, and beyond that no more than there are pixels.
    """
    share = 1.0 if config.stag15.control_points == "fixed" else extent / image_extent
    wanted = int(np.floor(config.stag15.control_points_max * share + 0.5))
    return max(CUBIC + 1, min(wanted, extent))


@compiled
def _distances(
    points_m: F32, mask: Bool, corner: tuple[int, int], control_m: F64, rows: SpanBasis, columns: SpanBasis
) -> F64:
    """Return the distance of each marked point of a window to a spline at the point's own parameters.

    Points, (3, H, W), and control points, (3, rows.size, columns.size), are in meters. The corner is the
    first row and column of the window, (h, w) as the mask, and the bases are at its rows and columns.
    """
    height, width = mask.shape
    top, left = corner
    count = 0
    for y in range(height):
        for x in range(width):
            count += mask[y, x]
    distances, squares = np.empty(count), np.empty(width)
    net, weights = np.empty(control_m.shape[2]), np.ascontiguousarray(columns.values.T)
    w0, w1, w2, w3 = weights[0], weights[1], weights[2], weights[3]
    edges, spans = span_edges(columns.starts)
    n = 0
    for y in range(height):
        squares[:] = 0.0
        first = rows.starts[y]
        for c in range(3):
            for k in range(net.size):
                net[k] = 0.0
                for i in range(4):
                    net[k] += rows.values[y, i] * control_m[c, first + i, k]
            along = points_m[c, top + y, left:]
            for s in range(spans):
                k = columns.starts[edges[s]]
                v0, v1, v2, v3 = net[k], net[k + 1], net[k + 2], net[k + 3]
                for x in range(edges[s], edges[s + 1]):
                    off = along[x] - ((v0 * w0[x] + v1 * w1[x]) + (v2 * w2[x] + v3 * w3[x]))
                    squares[x] += off * off
        for x in range(width):
            squares[x] = np.sqrt(squares[x])
        for x in range(width):
            if mask[y, x]:
                distances[n] = squares[x]
                n += 1
    return distances
