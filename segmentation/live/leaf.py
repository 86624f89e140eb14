"""Leaves of the live tree, and how well their surfaces still explain them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F32, F64, I32, Bool, Intp, compiled
from nurbseg.segmentation.config import OUTLIER_DEVIATIONS, Metric, SegmentationConfig
from nurbseg.segmentation.labels.images import by_label, inner_pixels
from nurbseg.segmentation.points.grid import DepthGrid
from nurbseg.segmentation.segments import Node, Trial
from nurbseg.segmentation.surfaces.curvature import all_metrics
from nurbseg.segmentation.surfaces.fit import Fit
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS
from nurbseg.segmentation.surfaces.noise import noise_floors
from nurbseg.segmentation.surfaces.surface import NurbsSurface
from nurbseg.segmentation.vocabulary import StopReason

#: A leaf's rim, mixed with the background, does not count if at least this share of the leaf is inside it.
_INNER_SHARE = 0.3


@dataclass(slots=True)
class Attempt:
    """The last attempt to split a leaf: why it failed, in which frame, and how many frames ago."""

    stop: StopReason
    trial: Trial | None
    frame: int
    age: int = 0


@dataclass(slots=True, eq=False)
class LiveLeaf:
    """A leaf of the live tree; it is the same object in all frames.

    Parameters
    ----------
    node : Node
        Its node of the tree.

    Attributes
    ----------
    surface : NurbsSurface or None
        Its surface, moved since it was fitted.
    age : int
        Frames since it was fitted.
    level : float
        Mean squared residual after the last fit, in units of the noise; NaN if unknown.
    tried : float
        The same at the last trial of a split, or when the leaf was made; NaN if unknown.
    rms_per_m : float
        Root mean square residual of inverse depth, 1/m.
    attempt : Attempt or None
        The last attempt to split it, if not out of date.
    """

    node: Node
    surface: NurbsSurface | None = field(init=False)
    age: int = 0
    level: float = float("nan")
    tried: float = float("nan")
    rms_per_m: float = 0.0
    attempt: Attempt | None = None

    def __post_init__(self) -> None:
        self.surface = self.node.fit.surface

    def refit(self, fitted: Node) -> None:
        """Give it the grid pixels and the fit of this frame."""
        self.node.grid_pixels, self.node.fit = fitted.grid_pixels, fitted.fit
        self.surface, self.age, self.level = fitted.fit.surface, 0, float("nan")

    @property
    def attempt_age(self) -> int:
        """Frames since the last attempt to split it; 0 without one."""
        return 0 if self.attempt is None else self.attempt.age


#: Two leaves, in any order.
LeafPair = frozenset[LiveLeaf]


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """How well surfaces explain their labels, by label; 0 is none.

    Parameters
    ----------
    counts : (labels + 1,) int64
        Number of grid pixels.
    mean_squared : (labels + 1,) float64
        Mean of the limited squared residuals, in units of the noise: 1 is expected.
    unreached : (labels + 1,) float64
        Share of grid pixels that the surface does not reach.
    """

    counts: NDArray[np.int64]
    mean_squared: NDArray[np.float64]
    unreached: NDArray[np.float64]


def misfit(
    labels: NDArray[np.int32], lattice: SurfaceLattice, grid: DepthGrid, noise_per_m: float, leaves: int
) -> Misfit:
    """Measure how well surfaces explain their labels.

    Parameters
    ----------
    labels : (h, w) int32
        Labels on the grid, 1 to `leaves`; 0 is none.
    lattice : SurfaceLattice
        Of the labels' surfaces.
    grid : DepthGrid
        The points.
    noise_per_m : float
        Standard deviation of inverse depth, 1/m.
    leaves : int
        Number of labels.
    """
    size = leaves + 1
    # Of the rim and of the inner pixels: count, count not reached, sum of squares.
    sums = np.zeros((size, 2, 3))
    explained, inner = lattice.image(labels), inner_pixels(labels)
    _sum_misfits(labels, grid.inverse_depth, 1.0 / noise_per_m, OUTLIER_DEVIATIONS, explained, inner, sums)
    every = sums.sum(axis=1)
    thin = sums[:, 1, 0] < _INNER_SHARE * every[:, 0]
    judged = np.where(thin[:, np.newaxis], every, sums[:, 1])
    square = judged[:, 2] / np.maximum(judged[:, 0], 1.0)
    counts = every[:, 0].astype(np.int64)
    return Misfit(counts, square, every[:, 1] / np.maximum(counts, 1))


@compiled
def _sum_misfits(
    labels: I32, inverse_depth: F32, per_deviation: float, most: float, explained: F32, inner: Bool, sums: F64
) -> None:
    """Sum by label over rim and inner pixels: 1, those not reached, limited squared residuals."""
    height, width = labels.shape
    for r in range(height):
        for c in range(width):
            label = labels[r, c]
            if label == 0:
                continue
            own = sums[label, np.int64(inner[r, c])]
            own[0] += 1.0
            own[1] += not explained[r, c] < np.inf
            deviation = min(per_deviation * abs(explained[r, c] - inverse_depth[r, c]), most)
            own[2] += deviation * deviation


def update_residuals(
    leaves: Sequence[LiveLeaf],
    labels: NDArray[np.int32],
    lattice: SurfaceLattice,
    grid: DepthGrid,
    config: SegmentationConfig,
) -> list[LiveLeaf]:
    """Update each leaf's grid pixels, and the residuals and metrics of its moved surface.

    Parameters
    ----------
    leaves : sequence of LiveLeaf
        Of the labels 1, 2, ...
    labels : (h, w) int32
        Labels on the grid.
    lattice : SurfaceLattice
        Of their surfaces.
    grid : DepthGrid
        The points.
    config : SegmentationConfig
        The deciding metric, and limits of the metrics.

    Returns
    -------
    list of LiveLeaf
        Leaves whose surface does not reach all of their grid pixels; they have no fit.
    """
    size = len(leaves) + 1
    order, bounds = by_label(labels.reshape(-1), size)
    residuals_m, pixels = np.empty(order.size), np.empty(order.size, dtype=np.intp)
    sums = np.zeros((size, 5))
    width = grid.image_shape[1]
    _measure(
        order,
        labels.reshape(-1),
        lattice.image(labels).reshape(-1),
        grid.inverse_depth.reshape(-1),
        grid.distances_m.reshape(-1),
        # Outliers must not raise the limit for further outliers.
        OUTLIER_DEVIATIONS * config.extended.inverse_depth_noise,
        config.large_error_m,
        (labels.shape[1], width, grid.step),
        residuals_m,
        pixels,
        sums,
    )
    floors = noise_floors(grid, labels, size, config)
    mae, mse, _, square, unreached = (sums / np.maximum(np.diff(bounds), 1)[:, np.newaxis]).T
    rms_per_m = np.sqrt(square)
    not_reached = []
    for label, leaf in enumerate(leaves, start=1):
        own = slice(bounds[label], bounds[label + 1])
        leaf.rms_per_m = float(rms_per_m[label])
        fitted_now = leaf.age == 0 and leaf.surface is not None and leaf.node.fit.surface is leaf.surface
        if fitted_now and np.array_equal(leaf.node.grid_pixels, order[own]):
            # Fitted to the same grid pixels, more exactly.
            continue
        leaf.node.grid_pixels = order[own]
        if leaf.surface is None or unreached[label] > 0:
            leaf.node.fit = Fit(None, np.zeros(0), {}, leaf.node.fit.reason, pixels[own])
            not_reached.append(leaf)
            continue
        values: dict[Metric, float] = {
            "mse": float(mse[label]),
            "mae": float(mae[label]),
            "ve": float(max(mse[label] - mae[label] ** 2, 0.0)),
            "nle": float(sums[label, 2]),
        }
        fit = Fit(leaf.surface, residuals_m[own], values, "", pixels[own], float(floors[label]))
        if config.metric in CURVATURE_METRICS:
            fit = replace(fit, values=all_metrics(fit, width, config))
        leaf.node.fit = fit
    return not_reached


@compiled
def _measure(
    order: Intp,
    labels: I32,
    explained: F32,
    inverse_depth: F32,
    distances_m: F32,
    most_per_m: float,
    large_m: float,
    widths: tuple[int, int, int],
    residuals_m: F64,
    pixels: Intp,
    sums: F64,
) -> None:
    """Fill in residuals in space and pixels, by label; sum residuals, count large and missing ones."""
    grid_width, image_width, step = widths
    for n in range(order.size):
        pixel = order[n]
        row = pixel // grid_width
        pixels[n] = (row * image_width + pixel - row * grid_width) * step
        label = labels[pixel]
        if label == 0:
            continue
        own = sums[label]
        if not explained[pixel] < np.inf:
            own[4] += 1.0
            continue
        beyond_per_m = abs(np.float64(explained[pixel]) - inverse_depth[pixel])
        # Both points lie on one ray.
        residual_m = distances_m[pixel] * beyond_per_m / explained[pixel]
        residuals_m[n] = residual_m
        own[0] += residual_m
        own[1] += residual_m * residual_m
        own[2] += residual_m > large_m
        own[3] += min(beyond_per_m, most_per_m) ** 2
