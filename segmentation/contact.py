"""Where two surfaces meet: whether they touch, and how concave the crease between them is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.inverse_depth import inverse_depth_at
from nurbseg.segmentation.normals import normals_from_slopes
from nurbseg.segmentation.rays import Rays
from nurbseg.segmentation.surface import NurbsSurface

#: Surfaces are compared across so many pixels without depth, at most, and by their points and normals so
#: many pixels inside their border; both in pixels of an image 640 wide.
_REACH_PX = 6
_INSET_PX = 4
#: Surfaces are in contact where so many samples of their border touch, and such a share of all.
_TOUCHING_LEAST = 4
_TOUCHING_SHARE = 0.5

_Values = NDArray[np.float64]
#: Gives inverse depth and its slopes from labels, columns and rows.
Evaluation = Callable[[NDArray[np.int32], _Values, _Values], tuple[_Values, _Values, _Values]]


@dataclass(frozen=True, slots=True)
class Meeting:
    """What was measured along the common border of two labels.

    Parameters
    ----------
    first, second : int
        Labels, the smaller one first.
    samples : int
        Places along the border where a row or column crosses it.
    touching : int
        Samples where the tangent planes of both surfaces, carried to the border, agree.
    concavity_sum : float
        Sum over the touching samples of the turn of the normals towards each other, about radians: more
        than 0 where the crease is concave, less where it is convex.
    """

    first: int
    second: int
    samples: int
    touching: int
    concavity_sum: float


def in_contact(samples: float, touching: float) -> bool:
    """Say whether enough samples of a common border touch, in number and as a share of all."""
    return touching >= _TOUCHING_LEAST and touching >= _TOUCHING_SHARE * samples


def meetings(
    labels: NDArray[np.int32],
    surfaces: Sequence[NurbsSurface | None],
    rays: Rays,
    *,
    gap_per_m: float,
    evaluate: Evaluation | None = None,
) -> tuple[Meeting, ...]:
    """Measure every common border of two labels.

    Parameters
    ----------
    labels : (H, W) int32
        1 to the number of surfaces; 0 where there is no point.
    surfaces : sequence of NurbsSurface or None
        That of each label; a label without one touches nothing.
    rays : Rays
        Of the camera.
    gap_per_m : float
        Tangent planes that differ by less inverse depth at the border agree, 1/m.
    evaluate : callable, optional
        Takes labels, columns and rows (pixels), (N,) each; gives inverse depth and its slopes along both,
        NaN where a label has no surface. By default the surfaces themselves are evaluated.

    Returns
    -------
    tuple of Meeting
        In ascending order of their labels.
    """
    unit = labels.shape[1] / 640.0
    crossings = _crossings(labels, max(1, round(_REACH_PX * unit)))
    if crossings.size == 0:
        return ()
    # Points and normals of both surfaces, inside of the border, and their tangent planes at it.
    inset = max(1.0, _INSET_PX * unit)
    row, column, down, across, apart = (crossings[:, k].astype(np.float64) for k in range(2, 7))
    middle = row + 0.5 * apart * down, column + 0.5 * apart * across
    # Both sides at once: first all places before the borders, then all behind.
    label = np.concatenate([crossings[:, 0], crossings[:, 1]])
    v, u = (
        np.concatenate([place - inset * step, place + (apart + inset) * step])
        for place, step in ((row, down), (column, across))
    )
    per_m, slope_u, slope_v = (evaluate or partial(_evaluated, surfaces))(label, u, v)
    at_border = per_m + slope_u * (np.tile(middle[1], 2) - u) + slope_v * (np.tile(middle[0], 2) - v)
    x, y = rays.at(u, v)
    points = np.stack([x, y, np.ones_like(x)], axis=1) / per_m[:, np.newaxis]
    normals = normals_from_slopes(slope_u, slope_v, per_m, x, y, rays.focal_px)
    (point_a, point_b), (normal_a, normal_b), (border_a, border_b) = (
        np.split(each, 2) for each in (points, normals, at_border)
    )
    touching = np.abs(border_a - border_b) < gap_per_m
    apart_m = point_b - point_a
    length = np.maximum(np.sqrt(np.einsum("nc,nc->n", apart_m, apart_m)), 1e-9)
    concavity = -np.einsum("nc,nc->n", normal_b - normal_a, apart_m) / length
    concavity = np.where(touching, np.nan_to_num(concavity), 0.0)

    first, second = crossings[:, :2].min(axis=1), crossings[:, :2].max(axis=1)
    pairs, pair = np.unique(first.astype(np.int64) << 32 | second, return_inverse=True)
    samples = np.bincount(pair)
    touches = np.bincount(pair, weights=touching)
    sums = np.bincount(pair, weights=concavity)
    return tuple(
        Meeting(int(key >> 32), int(key & 0xFFFFFFFF), int(n), int(t), float(c))
        for key, n, t, c in zip(pairs, samples, touches, sums, strict=True)
    )


def _crossings(labels: NDArray[np.int32], reach: int) -> NDArray[np.int32]:
    """Find where rows and columns go from one label to another, over `reach` pixels at most.

    Returns (N, 7): label before and after, row and column of the last pixel before, step along rows and
    columns (1, 0 or 0, 1), and pixels from the one to the other.
    """
    found = []
    flat, width = labels.reshape(-1), labels.shape[1]
    for down, across in ((0, 1), (1, 0)):
        last = labels.shape[0] - 1 - down, labels.shape[1] - 1 - across
        differ = labels[: last[0] + 1, : last[1] + 1] != labels[down:, across:]
        # Ends of segments; those with nothing beyond them are followed until something comes.
        places = np.flatnonzero(differ)
        rows, columns = np.divmod(places, differ.shape[1])
        before = labels[rows, columns]
        some = before > 0
        rows, columns, before = rows[some], columns[some], before[some]
        for apart in range(1, reach + 1):
            inside = (rows + apart * down < labels.shape[0]) & (columns + apart * across < width)
            rows, columns, before = rows[inside], columns[inside], before[inside]
            after = flat[(rows + apart * down) * width + columns + apart * across]
            crossed = (after > 0) & (after != before)
            size = int(np.count_nonzero(crossed))
            parts = np.empty((size, 7), dtype=np.int32)
            for k, column in enumerate((before, after, rows, columns)):
                parts[:, k] = column[crossed]
            parts[:, 4:] = down, across, apart
            found.append(parts)
            empty = after == 0
            rows, columns, before = rows[empty], columns[empty], before[empty]
    return np.concatenate(found)


def _evaluated(
    surfaces: Sequence[NurbsSurface | None],
    label: NDArray[np.int32],
    u: NDArray[np.float64],
    v: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Evaluate at each place the surface of its label: inverse depth and slopes, NaN without a surface."""
    results = tuple(np.full(label.size, np.nan) for _ in range(3))
    for number, surface in enumerate(surfaces, start=1):
        places = np.flatnonzero(label == number)
        if surface is None or places.size == 0:
            continue
        for result, values in zip(results, inverse_depth_at(surface, u[places], v[places]), strict=True):
            result[places] = values
    return results  # type: ignore[return-value]


__all__ = ["Evaluation", "Meeting", "meetings"]
