"""Planes that meet in a crease, which one smooth surface follows within noise: each becomes a surface."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, I64, Intp, compiled
from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.extended.grid_features import GridFeatures
from nurbseg.segmentation.extended.memory import LeafMemory
from nurbseg.segmentation.extended.parts import chain_components, judge_split, nodes_of
from nurbseg.segmentation.extended.splitting import entropy
from nurbseg.segmentation.labels.regions import large_components
from nurbseg.segmentation.points.grid import DepthGrid, union
from nurbseg.segmentation.segments import Node, Trial, leaves_below, splits_in
from nurbseg.segmentation.surfaces.inverse_depth import DepthFitter
from nurbseg.segmentation.surfaces.metrics import CURVATURE_METRICS, residual_metrics
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable
from nurbseg.segmentation.vocabulary import Division, StopReason

#: Least angle between two planes that meet in a crease, degrees.
ANGLE_LEAST = 20.0
#: Least size of a part, in T_p.
PIECE_FACTOR = 4.0
#: Least share of the grid of a leaf that is looked at.
_LARGE_SHARE = 0.06
#: Root mean square residual up to which one plane explains a leaf, in deviations of the noise.
_ONE_PLANE = 1.7
#: A plane explains a point up to so many deviations; residuals beyond so many count no more than these.
_EXPLAINED, _LIMIT = 3.0, 4.0
#: Least share of a leaf that planes explain, and how many there are at most.
_EXPLAINED_SHARE, _PLANES_MOST = 0.9, 3
#: Points of a leaf by which planes are found, about, and triples of them that are drawn for each.
_POINTS, _TRIPLES = 1200, 150
#: Times that planes are fitted again to the points near them, when they are found and when they are judged.
_REFITS_FOUND, _REFITS = 3, 4
#: What is added to the variances of rays, as a share of both about the first ray.
_RIDGE_SHARE = 1e-6
#: Side of the squares within which points vote for a plane, pixels of a 640-wide image.
_VOTES_PX = 14.0


def split_at_creases(
    root: Node,
    features: GridFeatures,
    config: SegmentationConfig,
    is_asked: Callable[[Node, float], bool] = lambda leaf, rms_per_m: True,
) -> None:
    """Split large leaves at creases between planes.

    Far from the camera a spline rounds a crease off by less than the noise. Its metric is then at the floor,
    and the ratio keeps no cut there. The floor is that of noise alone, but the residuals along a crease are
    alike, which noise is not. What shows them is a comparison of two surfaces that follow the same noise
    equally well. One is a spline; the other is the same kind of spline, added to the planes of the parts, and
    so folded where these meet. A leaf is split if the ratio of their metrics (eq. 5) is below T. No floor is
    needed: noise is the same in both. On a smooth surface planes leave folds of their own, which the spline
    would have to undo, and the ratio is above 1. Nothing is split by metrics of curvature, which say nothing
    about points.

    Parameters
    ----------
    root : Node
        Of a tree that has grown, which is changed. A leaf with creases gets two parts: the largest, and the
        other, or a node without a surface that chains several.
    features : GridFeatures
        The frame.
    config : SegmentationConfig
        The noise, T, T_p, T_d, T_s, and what surfaces are made of.
    is_asked : callable
        Whether a leaf is looked at, given it and the root mean square residual of one plane, 1/m: in a tree
        that is continued only where it has changed. Called for large leaves that one plane does not explain.
    """
    if config.metric in CURVATURE_METRICS:
        return
    noise_per_m = config.extended.inverse_depth_noise
    least, splits = _LARGE_SHARE * features.grid.valid.size, splits_in(root)
    for leaf in leaves_below(root):
        if leaf.fit.surface is None or leaf.grid_pixels.size < least:
            continue
        if leaf.cuts_above >= config.depth_max or splits >= config.splits_max:
            continue
        some = leaf.grid_pixels[:: max(1, leaf.grid_pixels.size // _POINTS)].copy()
        off_per_m = plane_through(some, features.grid, noise_per_m, refits=0)[1]
        is_explained = _limited_rms(off_per_m, noise_per_m) <= _ONE_PLANE * noise_per_m
        if not is_explained and is_asked(leaf, float(np.sqrt(np.mean(np.square(off_per_m))))):
            pieces = sorted(_pieces(leaf, some, features, config), key=lambda piece: -piece.size)
            trial = _folded(pieces, features, config) if len(pieces) > 1 else None
            if trial is not None and trial.kept:
                _split(leaf, pieces, trial, features, config)
                splits += 1


def plane_through(
    grid_pixels: NDArray[np.intp], grid: DepthGrid, noise_per_m: float, *, refits: int = _REFITS
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a plane to points by least squares of inverse depth, and again without those far from it.

    Parameters
    ----------
    grid_pixels : (N,) intp
        Flat grid pixels, at least one, each of which has a point.
    grid : DepthGrid
        The points.
    noise_per_m : float
        Standard deviation of inverse depth, 1/m: points within three of them, or within twice the root mean
        square residual, are fitted again.
    refits : int
        How often.

    Returns
    -------
    plane : (3,) float64
        n of the plane n . p = 1, 1/m. The inverse depth of its points is n . (x / z, y / z, 1).
    off_per_m : (N,) float64
        How far the inverse depth of each point is from it, 1/m.
    """
    inverse_depth = grid.inverse_depth.reshape(-1)[grid_pixels]
    off_per_m, limit_per_m = np.zeros(grid_pixels.size), np.inf
    for _ in range(1 + refits):
        plane = _fitted(grid_pixels, *_flat(grid), grid.inverse_depth.reshape(-1), off_per_m, limit_per_m)
        off_per_m = np.abs(_on_plane(grid_pixels, *_flat(grid), plane) - inverse_depth)
        limit_per_m = max(_EXPLAINED * noise_per_m, 2.0 * _limited_rms(off_per_m, noise_per_m))
    return plane, off_per_m


def _limited_rms(off_per_m: NDArray[np.float64], noise_per_m: float) -> float:
    return float(np.sqrt(np.mean(np.square(np.minimum(off_per_m, _LIMIT * noise_per_m)))))


def _flat(grid: DepthGrid) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return x, y and z of all grid pixels, meters."""
    x_m, y_m, z_m = grid.coordinates_m.reshape(3, -1)
    return x_m, y_m, z_m


def angle_between(planes: Sequence[NDArray[np.float64]]) -> float:
    """Return the largest angle between two of some planes, degrees."""
    normals = np.array([plane / max(float(np.linalg.norm(plane)), 1e-12) for plane in planes])
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0).min())))


@compiled
def _fitted(
    grid_pixels: Intp, x_m: F32, y_m: F32, z_m: F32, inverse_depth: F32, off_per_m: F64, limit_per_m: float
) -> F64:
    """Fit a plane to the grid pixels that are off by less than a limit, by sums about the first of all."""
    first = grid_pixels[0]
    x0, y0, d0 = x_m[first] / z_m[first], y_m[first] / z_m[first], inverse_depth[first]
    count = sx = sy = sd = sxx = syy = sxy = sxd = syd = 0.0
    for n in range(grid_pixels.size):
        if off_per_m[n] < limit_per_m:
            at = np.uint32(grid_pixels[n])
            x, y, d = x_m[at] / z_m[at] - x0, y_m[at] / z_m[at] - y0, inverse_depth[at] - d0
            count, sx, sy, sd, sxx, syy = count + 1.0, sx + x, sy + y, sd + d, sxx + x * x, syy + y * y
            sxy, sxd, syd = sxy + x * y, sxd + x * d, syd + y * d
    count = max(count, 1.0)
    # Points on a line do not tell the slope across it.
    ridge = _RIDGE_SHARE * (sxx + syy) + 1e-12
    sxx, syy, sxy = sxx - sx * sx / count + ridge, syy - sy * sy / count + ridge, sxy - sx * sy / count
    sxd, syd = sxd - sx * sd / count, syd - sy * sd / count
    determinant = sxx * syy - sxy * sxy
    plane = np.empty(3)
    plane[0], plane[1] = (syy * sxd - sxy * syd) / determinant, (sxx * syd - sxy * sxd) / determinant
    plane[2] = d0 + (sd - plane[0] * sx - plane[1] * sy) / count - plane[0] * x0 - plane[1] * y0
    return plane


@compiled
def _on_plane(grid_pixels: Intp, x_m: F32, y_m: F32, z_m: F32, plane: F64) -> F64:
    """Return the inverse depths of a plane at grid pixels."""
    found = np.empty(grid_pixels.size)
    for n in range(grid_pixels.size):
        at = np.uint32(grid_pixels[n])
        found[n] = plane[0] * (x_m[at] / z_m[at]) + plane[1] * (y_m[at] / z_m[at]) + plane[2]
    return found


def _pieces(
    leaf: Node, some: NDArray[np.intp], features: GridFeatures, config: SegmentationConfig
) -> list[NDArray[np.intp]]:
    """Return the connected parts of a leaf by the plane nearest to them; none if some do not explain it."""
    grid, noise_per_m = features.grid, config.extended.inverse_depth_noise
    rng = np.random.default_rng(entropy(config.seed, leaf.first_name))
    planes = _planes(*_rays(some, grid), _EXPLAINED * noise_per_m, rng)
    if planes is None or angle_between(list(planes)) < ANGLE_LEAST:
        return []
    mask = grid.window_mask(leaf.grid_pixels)[1]
    inverse_depth = grid.inverse_depth.reshape(-1)[leaf.grid_pixels]
    side = 2 * round(0.5 * _VOTES_PX * grid.unit_px / grid.step) + 1
    image, costs = np.zeros(mask.shape, dtype=np.float32), []
    for plane in planes:
        off = np.abs(_on_plane(leaf.grid_pixels, *_flat(grid), plane) - inverse_depth)
        off = np.minimum(off, 2.0 * _EXPLAINED * noise_per_m)
        image[mask] = np.square(off / noise_per_m)
        costs.append(cv2.blur(image, (side, side), borderType=cv2.BORDER_CONSTANT)[mask])
    return large_components(
        leaf.grid_pixels,
        1 + np.argmin(costs, axis=0).astype(np.int32),
        features.adjacency,
        grid.inverse_depth,
        gap_per_m=config.extended.inverse_depth_gap,
        grid_pixels_min=PIECE_FACTOR * features.grid_pixels_min(config),
    )[0]


def _rays(grid_pixels: NDArray[np.intp], grid: DepthGrid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rays (x / z, y / z, 1) of points, and their inverse depths."""
    points_m = grid.coordinates_m.reshape(3, -1)[:, grid_pixels].astype(np.float64)
    return np.ascontiguousarray((points_m / points_m[2]).T), 1.0 / points_m[2]


def _planes(
    rays: NDArray[np.float64],
    inverse_depth: NDArray[np.float64],
    limit_per_m: float,
    rng: np.random.Generator,
) -> NDArray[np.float64] | None:
    """Find the fewest planes, two at least, that explain nearly all points; None if they do not."""
    count, planes, rest = inverse_depth.size, np.zeros((0, 3)), np.arange(inverse_depth.size)
    while len(planes) < _PLANES_MOST and rest.size >= 3:
        x, y = np.ascontiguousarray(rays[rest, :2].T)
        triples = rng.integers(0, rest.size, (_TRIPLES, 3))
        plane, explained = _plane_of_most(x, y, inverse_depth[rest], triples, limit_per_m)
        # Those that follow explain no more than this one.
        if count - rest.size + (_PLANES_MOST - len(planes)) * explained < _EXPLAINED_SHARE * count:
            return None
        planes = np.concatenate([planes, plane[np.newaxis]])
        off = np.abs(planes @ rays.T - inverse_depth)
        for _ in range(_REFITS_FOUND if len(planes) > 1 else 0):
            is_own = (off == off.min(axis=0)) & (off < limit_per_m)
            for n, own in enumerate(is_own):
                A = rays[own]
                if len(A) > 3:
                    planes[n] = np.linalg.lstsq(A.T @ A, A.T @ inverse_depth[own], rcond=None)[0]
            off = np.abs(planes @ rays.T - inverse_depth)
        rest = np.flatnonzero(off.min(axis=0) >= limit_per_m)
        if len(planes) >= 2 and rest.size <= (1.0 - _EXPLAINED_SHARE) * count:
            return planes
    return None


@compiled
def _plane_of_most(x: F64, y: F64, inverse_depth: F64, triples: I64, limit_per_m: float) -> tuple[F64, int]:
    """Return the plane through three points from which points are least far, and how many it explains."""
    best, least, most = np.zeros(3), np.inf, 0
    for n in range(triples.shape[0]):
        i, j, k = triples[n]
        ax, ay, ad = x[j] - x[i], y[j] - y[i], inverse_depth[j] - inverse_depth[i]
        bx, by, bd = x[k] - x[i], y[k] - y[i], inverse_depth[k] - inverse_depth[i]
        area = ax * by - ay * bx
        if abs(area) < 1e-4:
            continue
        slope_x, slope_y = (ad * by - ay * bd) / area, (ax * bd - ad * bx) / area
        level = inverse_depth[i] - slope_x * x[i] - slope_y * y[i]
        squares, explained = 0.0, 0
        for m in range(x.size):
            off = abs(slope_x * x[m] + slope_y * y[m] + level - inverse_depth[m])
            explained += off < limit_per_m
            off = min(off, limit_per_m)
            squares += off * off
        if squares < least:
            least, most = squares, explained
            best[0], best[1], best[2] = slope_x, slope_y, level
    return best, most


def _folded(
    pieces: Sequence[NDArray[np.intp]], features: GridFeatures, config: SegmentationConfig
) -> Trial | None:
    """Judge a surface that is folded between pieces against a smooth one, where planes explain the points."""
    grid, noise_per_m = features.grid, config.extended.inverse_depth_noise
    folds_per_m, planes, explained = np.zeros(grid.valid.size), [], []
    for piece in pieces:
        plane, off_per_m = plane_through(piece, grid, noise_per_m)
        folds_per_m[piece] = _on_plane(piece, *_flat(grid), plane)
        planes.append(plane)
        explained.append(piece[off_per_m < _EXPLAINED * noise_per_m])
    if min(own.size for own in explained) < features.grid_pixels_min(config):
        return None
    if angle_between(planes) < ANGLE_LEAST:
        return None
    every = union(explained)
    smooth_m, folded_m = (
        _residuals(every, folds, grid, config) for folds in (np.zeros_like(folds_per_m), folds_per_m)
    )
    whole, *parts = (
        (residual_metrics(residuals_m[own], config)[config.metric], own.size)
        for residuals_m, own in ((smooth_m, every), *((folded_m, own) for own in explained))
    )
    return judge_split(whole, parts, config)


def _residuals(
    every: NDArray[np.intp], folds_per_m: NDArray[np.float64], grid: DepthGrid, config: SegmentationConfig
) -> NDArray[np.float64]:
    """Return the distances of points to a spline that is added to folds, meters, by grid pixel."""
    inverse_depth, folds = grid.inverse_depth.reshape(-1)[every], folds_per_m[every]
    shifted = np.zeros(grid.shape, dtype=np.float32)
    # Surfaces have a positive inverse depth; a spline plus a number is fitted as well.
    shifted.reshape(-1)[every] = inverse_depth - folds + 1.0
    ((_, fit),) = DepthFitter(replace(grid, inverse_depth=shifted), config).of_pixels([every])
    rows, columns = np.divmod(every.astype(np.int32), np.int32(grid.shape[1]))
    step, ones = np.int32(grid.step), np.ones(every.size, dtype=np.int32)
    fitted = SurfaceTable([fit.surface]).inverse_depths(ones, rows * step, columns * step) - 1.0 + folds
    residuals_m = np.zeros(grid.valid.size)
    residuals_m[every] = np.abs(fitted / inverse_depth - 1.0) * grid.distances_m.reshape(-1)[every]
    return residuals_m


def _split(
    leaf: Node,
    pieces: Sequence[NDArray[np.intp]],
    trial: Trial,
    features: GridFeatures,
    config: SegmentationConfig,
) -> None:
    """Divide a leaf into pieces, the largest first."""
    parts = nodes_of(features.fitter.of_pixels(pieces), config)
    for part in parts:
        part.stop = part.stop or StopReason.UNTRIED
    parts[0].memory, leaf.memory = leaf.memory, None
    if isinstance(parts[0].memory, LeafMemory):
        parts[0].memory.forget()
    first, *others = parts
    name, depth = leaf.name, leaf.cuts_above + 1
    leaf.children = chain_components(f"{name}0", [first], depth), chain_components(f"{name}1", others, depth)
    leaf.division, leaf.stop, leaf.trial, leaf.judged = Division.CREASE, None, trial, None
