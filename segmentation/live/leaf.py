"""A leaf that lives from frame to frame, and how well its surface still explains it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled
from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.labels.segment_pixels import by_label
from nurbseg.segmentation.live.follow import inner_places
from nurbseg.segmentation.segments import Node
from nurbseg.segmentation.surfaces.inverse_depth import DepthGrid
from nurbseg.segmentation.surfaces.lattice import SurfaceLattice
from nurbseg.segmentation.surfaces.noise import SQUARE_MOST
from nurbseg.segmentation.surfaces.surface import Fit, NurbsSurface

#: A leaf's rim, mixed with what lies behind, is left out where this much of it is left.
_INNER_SHARE = 0.3
_FAR_DEVIATIONS = 3.0


@dataclass(slots=True, eq=False)
class LiveLeaf:
    """A leaf of the live tree.

    Parameters
    ----------
    node : Node
        Its node of the tree.
    number : int
        By which it is known as long as it lives.

    Attributes
    ----------
    surface : NurbsSurface or None
        Its surface, moved since it was fitted.
    age : int
        Frames since it was fitted.
    level : float
        Mean squared residual after the last fit, in units of the noise; NaN where that is not known.
    tried : float
        The same at the last trial of a split, or when the leaf was made; NaN where that is not known.
    rms_per_m : float
        Root mean square residual of inverse depth, 1/m.
    """

    node: Node
    number: int
    surface: NurbsSurface | None = field(init=False)
    age: int = 0
    level: float = float("nan")
    tried: float = float("nan")
    rms_per_m: float = 0.0

    def __post_init__(self) -> None:
        self.surface = self.node.fit.surface


@dataclass(frozen=True, slots=True, eq=False)
class Misfit:
    """How well surfaces explain their labels, by label; the first is of no label.

    Parameters
    ----------
    places : (labels + 1,) int64
        Places of the grid.
    square : (labels + 1,) float64
        Mean of the squared residuals in units of the noise, each limited; 1 is what noise leaves.
    far : (labels + 1,) float64
        Share of places beyond three deviations.
    unreached : (labels + 1,) float64
        Share of places that the surface does not reach.
    deviations : (h, w) float32
        Residual of every place in units of the noise, at most 4; 0 where there is no label.
    inner : (h, w) bool
        Places whose neighbours have their label.
    """

    places: NDArray[np.int64]
    square: NDArray[np.float64]
    far: NDArray[np.float64]
    unreached: NDArray[np.float64]
    deviations: NDArray[np.float32]
    inner: NDArray[np.bool_]


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
    deviations, inner = lattice.image(labels), inner_places(labels)
    # Of the rim and of the inner places: how many, not reached, sum of squares, and how many are far.
    sums = np.zeros((size, 2, 4))
    _sum_misfits(labels, grid.per_m, 1.0 / noise_per_m, SQUARE_MOST**0.5, deviations, inner, sums)
    every = sums.sum(axis=1)
    thin = sums[:, 1, 0] < _INNER_SHARE * every[:, 0]
    judged = np.where(thin[:, np.newaxis], every, sums[:, 1])
    means = judged / np.maximum(judged[:, :1], 1.0)
    places = every[:, 0].astype(np.int64)
    return Misfit(places, means[:, 2], means[:, 3], every[:, 1] / np.maximum(places, 1), deviations, inner)


@compiled
def _sum_misfits(
    labels: NDArray[np.int32],
    per_m: NDArray[np.float32],
    per_deviation: float,
    most: float,
    deviations: NDArray[np.float32],
    inner: NDArray[np.bool_],
    sums: NDArray[np.float64],
) -> None:
    """Turn the surfaces' inverse depths into residuals in units of the noise; sum them by label."""
    height, width = labels.shape
    for r in range(height):
        for c in range(width):
            label = labels[r, c]
            if label == 0:
                deviations[r, c] = 0.0
                continue
            own = sums[label, np.int64(inner[r, c])]
            own[0] += 1.0
            own[1] += not deviations[r, c] < np.inf
            deviation = min(per_deviation * abs(deviations[r, c] - per_m[r, c]), most)
            deviations[r, c] = deviation
            own[2] += deviation * deviation
            own[3] += deviation > _FAR_DEVIATIONS


def remeasured(
    leaves: Sequence[LiveLeaf],
    labels: NDArray[np.int32],
    lattice: SurfaceLattice,
    grid: DepthGrid,
    config: SegmentationConfig,
) -> None:
    """Give each leaf its places, its moved surface's residuals, and the metrics of these.

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
        Its `large_error_m` is T_l.
    """
    size = len(leaves) + 1
    order, bounds = by_label(labels.reshape(-1), size)
    residuals_m, pixels = np.empty(order.size), np.empty(order.size, dtype=np.intp)
    sums = np.zeros((size, 4))
    _measure(
        order,
        labels.reshape(-1),
        lattice.image(labels).reshape(-1),
        grid.per_m.reshape(-1),
        grid.distances_m.reshape(-1),
        # What is far off is not the leaf's own, and does not make room for more of its kind.
        SQUARE_MOST**0.5 * config.noise_per_m,
        config.large_error_m,
        (labels.shape[1], grid.points.image_shape[1], grid.step),
        residuals_m,
        pixels,
        sums,
    )
    mae, mse, _, square = (sums / np.maximum(np.diff(bounds), 1)[:, np.newaxis]).T
    rms_per_m = np.sqrt(square)
    for label, leaf in enumerate(leaves, start=1):
        own = slice(bounds[label], bounds[label + 1])
        leaf.rms_per_m = float(rms_per_m[label])
        if leaf.surface is None:
            continue
        values: dict[Metric, float] = {
            **leaf.node.fit.values,
            "mse": float(mse[label]),
            "mae": float(mae[label]),
            "ve": float(max(mse[label] - mae[label] ** 2, 0.0)),
            "nle": float(sums[label, 2]),
        }
        leaf.node.places = order[own]
        leaf.node.fit = Fit(leaf.surface, residuals_m[own], values, "", pixels[own], leaf.node.fit.floor)


@compiled
def _measure(
    order: NDArray[np.intp],
    labels: NDArray[np.int32],
    explained: NDArray[np.float32],
    per_m: NDArray[np.float32],
    distances_m: NDArray[np.float32],
    most_per_m: float,
    large_m: float,
    widths: tuple[int, int, int],
    residuals_m: NDArray[np.float64],
    pixels: NDArray[np.intp],
    sums: NDArray[np.float64],
) -> None:
    """Give residuals in space and pixels in the order of labels; sum them, their squares, and large ones."""
    grid_width, image_width, step = widths
    for n in range(order.size):
        place = order[n]
        row = place // grid_width
        pixels[n] = (row * image_width + place - row * grid_width) * step
        label = labels[place]
        if label == 0:
            continue
        if explained[place] < np.inf:
            beyond_per_m = abs(np.float64(explained[place]) - per_m[place])
            # The point and its surface point lie on one ray.
            residual_m = distances_m[place] * beyond_per_m / explained[place]
        else:
            # Beyond the reach of a surface not fitted anew yet, residuals count as the limit of noise.
            beyond_per_m = most_per_m
            residual_m = most_per_m / np.float64(per_m[place]) ** 2
        residuals_m[n] = residual_m
        own = sums[label]
        own[0] += residual_m
        own[1] += residual_m * residual_m
        own[2] += residual_m > large_m
        own[3] += min(beyond_per_m, most_per_m) ** 2


__all__ = ["LiveLeaf", "Misfit", "misfit", "remeasured"]
