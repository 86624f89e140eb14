"""The leaves of one frame in the next: surfaces moved, labels grown, borders settled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.lattice import SurfaceLattice
from nurbseg.segmentation.noise import SQUARE_MOST
from nurbseg.segmentation.surface import NurbsSurface

#: Differences of inverse depth between two frames that are another surface rather than motion, 1/m.
_MOTION_MOST_PER_M = 0.15
#: A surface does not go farther away than this, 1/m.
_LEAST_PER_M = 1e-2
#: Vote of a neighbour across a gap in depth, and of one at a distance of one pixel.
_ACROSS_GAP, _VOTE = 0.25, 1.4
#: Passes in which labels grow into places that have none.
_GROWTH = 12
_NEIGHBORS = ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1))


def moved_surfaces(
    surfaces: Sequence[NurbsSurface | None],
    lattice: SurfaceLattice,
    labels: NDArray[np.int32],
    per_m: NDArray[np.float32],
    inner: NDArray[np.bool_],
    step: int,
    noise_per_m: float,
) -> list[NurbsSurface | None]:
    """Move every surface by the linear change of inverse depth that its points tell.

    A spline holds linear functions exactly, so that the moved surface has the same knots. It follows any
    motion of a plane, and small motions of the others.

    Parameters
    ----------
    surfaces : sequence of NurbsSurface or None
        Of the labels 1, 2, ... in the frame before.
    lattice : SurfaceLattice
        Of these surfaces.
    labels : (h, w) int32
        Labels on the grid.
    per_m : (h, w) float32
        Inverse depth of this frame on the grid, 1/m.
    inner : (h, w) bool
        Places whose neighbours have their label, which tell.
    step : int
        Pixels from one place of the grid to the next.
    noise_per_m : float
        Standard deviation of inverse depth, 1/m.

    Returns
    -------
    list of NurbsSurface or None
        The moved ones.
    """
    count = len(surfaces) + 1
    rows, columns = np.nonzero(inner)
    label = labels[rows, columns]
    change = per_m[rows, columns] - lattice.at(label, rows, columns)
    told = np.abs(change) < _MOTION_MOST_PER_M
    label, change = label[told].astype(np.intp), change[told].astype(np.float64)
    x, y = columns[told].astype(np.float64), rows[told].astype(np.float64)
    changes = np.zeros((count, 3))
    if label.size == 0:
        return list(surfaces)

    # First their mean, then a linear change of those that agree with it.
    n = np.bincount(label, minlength=count)
    some = np.maximum(n, 1)
    mean = np.bincount(label, weights=change, minlength=count) / some
    spread = np.bincount(label, weights=np.square(change - mean[label]), minlength=count) / some
    limit = np.maximum(6.0 * noise_per_m, 2.0 * np.sqrt(spread))
    agree = np.abs(change - mean[label]) < limit[label]
    label, change, x, y = label[agree], change[agree], x[agree], y[agree]
    n = np.bincount(label, minlength=count)
    some = np.maximum(n, 1)

    def total(weights: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.bincount(label, weights=weights, minlength=count), dtype=np.float64)

    mx, my, mc = total(x) / some, total(y) / some, total(change) / some
    x, y, change = x - mx[label], y - my[label], change - mc[label]
    # A ridge of one row and column of points keeps slivers from tilting.
    xx, yy, xy = total(x * x) + 4.0 * n + 1.0, total(y * y) + 4.0 * n + 1.0, total(x * y)
    xc, yc = total(x * change), total(y * change)
    determinant = xx * yy - xy * xy
    along_x, along_y = (yy * xc - xy * yc) / determinant, (xx * yc - xy * xc) / determinant
    changes[:, 0], changes[:, 1], changes[:, 2] = mc - along_x * mx - along_y * my, along_x, along_y
    return [
        None if surface is None else _moved(surface, changes[place], step)
        for place, surface in enumerate(surfaces, start=1)
    ]


def _moved(surface: NurbsSurface, change: NDArray[np.float64], step: int) -> NurbsSurface:
    u, v = (
        (knots[1:-3] + knots[2:-2] + knots[3:-1]) / (3.0 * step)
        for knots in (surface.knots_u, surface.knots_v)
    )
    weights = surface.weights + change[0] + change[1] * u + change[2] * v[:, np.newaxis]
    weights = np.maximum(weights, _LEAST_PER_M)
    points = surface.control_points_m * (surface.weights / weights)[..., np.newaxis]
    return replace(surface, control_points_m=points, weights=weights)


def inner_places(labels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Find places with a label whose eight neighbours have the same, (h, w) bool."""
    image = labels.astype(np.uint16)
    kernel = np.ones((3, 3), dtype=np.uint8)
    most = cv2.dilate(image, kernel, borderType=cv2.BORDER_REPLICATE)
    least = cv2.erode(image, kernel, borderType=cv2.BORDER_REPLICATE)
    return np.asarray((most == least) & (labels > 0), dtype=np.bool_)


def grown_labels(
    labels: NDArray[np.int32],
    wanted: NDArray[np.bool_],
    per_m: NDArray[np.float32],
    lattice: SurfaceLattice,
    limits_per_m: NDArray[np.float32],
) -> NDArray[np.int32]:
    """Let labels grow into unlabelled places that their surfaces explain.

    Parameters
    ----------
    labels : (h, w) int32
        Labels on the grid; 0 is none.
    wanted : (h, w) bool
        Places to label.
    per_m : (h, w) float32
        Inverse depth, 1/m.
    lattice : SurfaceLattice
        Of the labels' surfaces.
    limits_per_m : (labels + 1,) float32
        Residual from which on a label's surface does not explain a place, 1/m.

    Returns
    -------
    (h, w) int32
        The labels; places that no neighbour's surface explains stay 0.
    """
    padded = np.pad(labels, 1)
    width = padded.shape[1]
    rows, columns = np.nonzero(wanted)
    flat = padded.ravel()
    places = (rows + 1) * width + columns + 1
    own = per_m[rows, columns]
    steps = np.array([down * width + across for down, across in _NEIGHBORS[:4]])
    for _ in range(_GROWTH):
        if places.size == 0:
            break
        near = flat[places[:, np.newaxis] + steps]
        asked = np.flatnonzero(near.any(axis=1))
        if asked.size == 0:
            break
        near = near[asked]
        label = near.ravel()
        repeated = np.repeat(asked, len(steps))
        residual = np.abs(lattice.at(label, rows[repeated], columns[repeated]) - own[repeated])
        residual = np.where((label > 0) & (residual < limits_per_m[label]), residual, np.inf)
        residual = residual.reshape(near.shape)
        best = residual.argmin(axis=1)
        which = np.arange(asked.size)
        fits = np.isfinite(residual[which, best])
        if not fits.any():
            break
        flat[places[asked[fits]]] = near[which[fits], best[fits]]
        left = np.ones(places.size, dtype=np.bool_)
        left[asked[fits]] = False
        rows, columns, places, own = rows[left], columns[left], places[left], own[left]
    return flat.reshape(padded.shape)[1:-1, 1:-1].copy()


def settled_borders(
    labels: NDArray[np.uint16],
    per_m: NDArray[np.float32],
    lattice: SurfaceLattice,
    *,
    noise_per_m: float,
    gap_per_m: float,
) -> NDArray[np.uint16]:
    """Give every pixel at a border the cheapest of its own label, the largest and the least beside it.

    One pass of iterated conditional modes, as borders are refined in a first frame; passes of later frames
    go on with it.

    Parameters
    ----------
    labels : (H, W) uint16
        Labels of all pixels that have a point, or 0 where that is not known yet.
    per_m : (H, W) float32
        Inverse depth, 1/m; 0 where there is no point.
    lattice : SurfaceLattice
        Of the labels' surfaces.
    noise_per_m, gap_per_m : float
        Standard deviation of inverse depth, and smallest gap, 1/m.

    Returns
    -------
    (H, W) uint16
        The new labels.
    """
    kernel = np.ones((3, 3), dtype=np.uint8)
    most = cv2.dilate(labels, kernel)
    # 0 wraps around to the largest, so that it is never the least.
    least = (cv2.erode(labels - np.uint16(1), kernel) + np.uint16(1)).astype(np.uint16)
    rows, columns = np.nonzero((most != least) & (most > 0) & (per_m > 0))
    if rows.size == 0:
        return labels
    own = per_m[rows, columns]
    width = labels.shape[1] + 2
    padded_labels = np.pad(labels, 1).ravel()
    padded_per_m = np.pad(per_m, 1).ravel()
    places = (rows + 1) * width + columns + 1
    candidates = (labels[rows, columns], most[rows, columns], least[rows, columns])
    votes = [np.zeros(rows.size, dtype=np.float32) for _ in candidates]
    for down, across in _NEIGHBORS:
        at = places + (down * width + across)
        near = padded_labels[at]
        weight = np.where(np.abs(padded_per_m[at] - own) < gap_per_m, 1.0, _ACROSS_GAP).astype(np.float32)
        weight *= np.float32(_VOTE / np.hypot(down, across))
        for vote, label in zip(votes, candidates, strict=True):
            vote += weight * (near == label)
    best, cost = candidates[0].copy(), np.full(rows.size, np.inf, dtype=np.float32)
    for label, vote in zip(candidates, votes, strict=True):
        residual = lattice.at_pixels(label.astype(np.int32), rows, columns) - own
        value = np.minimum(np.square(residual / np.float32(noise_per_m)), np.float32(SQUARE_MOST)) - vote
        value[label == 0] = np.inf
        better = value < cost
        best[better], cost[better] = label[better], value[better]
    settled = labels.copy()
    settled[rows, columns] = best
    return settled


__all__ = ["grown_labels", "inner_places", "moved_surfaces", "settled_borders"]
