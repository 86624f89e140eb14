"""A leaf that lives from frame to frame, and how well its surface still explains it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import Metric, SegmentationConfig
from nurbseg.segmentation.follow import inner_places
from nurbseg.segmentation.inverse_depth import DepthGrid
from nurbseg.segmentation.lattice import SurfaceLattice
from nurbseg.segmentation.noise import SQUARE_MOST
from nurbseg.segmentation.segments import Node
from nurbseg.segmentation.surface import Fit, NurbsSurface

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
    patience : int
        Frames until it is looked at again for what its surface does not explain.
    """

    node: Node
    number: int
    surface: NurbsSurface | None = field(init=False)
    age: int = 0
    level: float = float("nan")
    tried: float = float("nan")
    rms_per_m: float = 0.0
    patience: int = 0

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
    inner = inner_places(labels)
    residual = np.abs(lattice.image(labels) - grid.per_m)
    unreached = (labels > 0) & ~np.isfinite(residual)
    deviations = np.minimum(residual * np.float32(1.0 / noise_per_m), np.float32(np.sqrt(SQUARE_MOST)))
    deviations[labels == 0] = 0.0
    flat = labels.ravel()
    size = leaves + 1
    places = np.bincount(flat, minlength=size)
    squares = np.square(deviations)
    far = (deviations > _FAR_DEVIATIONS).astype(np.float32)

    def mean(of: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        at = labels[mask]
        sums = np.bincount(at, weights=of[mask], minlength=size)
        return np.asarray(sums / np.maximum(np.bincount(at, minlength=size), 1), dtype=np.float64)

    n_inner = np.bincount(labels[inner], minlength=size)
    square, far_share = mean(squares, inner), mean(far, inner)
    every = labels > 0
    square_all, far_all = mean(squares, every), mean(far, every)
    thin = n_inner < _INNER_SHARE * places
    square = np.where(thin, square_all, square)
    far_share = np.where(thin, far_all, far_share)
    missed = np.bincount(flat[unreached.ravel()], minlength=size) / np.maximum(places, 1)
    return Misfit(places, square, far_share, missed, deviations, inner)


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
    flat = labels.ravel()
    order = np.argsort(flat.astype(np.uint16), kind="stable")
    size = len(leaves) + 1
    ends = np.cumsum(np.bincount(flat, minlength=size))
    fitted = lattice.image(labels).ravel()
    x, y, z = grid.points.coordinates_m.reshape(3, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # The point and its surface point lie on one ray.
        per_m = np.abs(fitted - grid.per_m.ravel())
        residuals_m = np.sqrt(x * x + y * y + z * z) * per_m / fitted
    # Beyond the reach of a surface that is not fitted anew yet, residuals count as the limit of noise.
    beyond = ~np.isfinite(residuals_m)
    residuals_m[beyond] = z[beyond] ** 2 * np.float32(4.0 * config.noise_per_m)
    per_m[beyond] = 4.0 * config.noise_per_m
    # What is far off is not the leaf's own, and does not make room for more of its kind.
    limit = np.float32(np.sqrt(SQUARE_MOST) * config.noise_per_m)
    places = np.bincount(flat, minlength=size)
    some = np.maximum(places, 1).astype(np.float64)
    mean_square, mean, nle, square = (
        np.asarray(np.bincount(flat, weights=each, minlength=size), dtype=np.float64)
        for each in (
            residuals_m * residuals_m,
            residuals_m,
            residuals_m > config.large_error_m,
            np.square(np.minimum(per_m, limit)),
        )
    )
    mse, mae, rms = mean_square / some, mean / some, np.sqrt(square / some)
    residuals = residuals_m[order].astype(np.float64)
    pixels = grid.points.pixels(order)
    for label, leaf in enumerate(leaves, start=1):
        own = slice(ends[label - 1], ends[label])
        leaf.rms_per_m = float(rms[label])
        if leaf.surface is None:
            continue
        values: dict[Metric, float] = {
            **leaf.node.fit.values,
            "mse": float(mse[label]),
            "mae": float(mae[label]),
            "ve": float(max(mse[label] - mae[label] ** 2, 0.0)),
            "nle": float(nle[label]),
        }
        leaf.node.places = order[own]
        leaf.node.fit = Fit(leaf.surface, residuals[own], values, "", pixels[own])


__all__ = ["LiveLeaf", "Misfit", "misfit", "remeasured"]
