"""Distances of points to the spline that was fitted to them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import compiled
from nurbseg.segmentation.surfaces.bspline import SpanBasis


def spline_distances(
    control_m: NDArray[np.float64],
    points_m: NDArray[np.float32],
    mask: NDArray[np.bool_],
    corner: tuple[int, int],
    rows: SpanBasis,
    columns: SpanBasis,
) -> NDArray[np.float64]:
    """Return the distance of each marked point of a window to a spline at the point's own parameters.

    Parameters
    ----------
    control_m : (3, rows.count, columns.count) float64
        Control points, metres.
    points_m : (3, H, W) float32
        Points, metres; read only where `mask` is set.
    mask : (h, w) bool
        Pixels of the window.
    corner : (int, int)
        First row and column of the window.
    rows, columns : SpanBasis
        At the rows and columns of the window.

    Returns
    -------
    (N,) float64
        Metres, in the order of pixels.
    """
    return _distances(
        points_m,
        np.ascontiguousarray(mask),
        *corner,
        control_m,
        rows.starts,
        rows.values,
        columns.starts,
        columns.values,
    )


@compiled
def _distances(
    points_m: NDArray[np.float32],
    mask: NDArray[np.bool_],
    top: int,
    left: int,
    control_m: NDArray[np.float64],
    starts_v: NDArray[np.intp],
    values_v: NDArray[np.float64],
    starts_u: NDArray[np.intp],
    values_u: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Distance of each marked point of a window to a spline at its own parameters, in the order of pixels."""
    height, width = mask.shape
    count = 0
    for y in range(height):
        for x in range(width):
            count += mask[y, x]
    distances, squares, off = np.empty(count), np.empty(width), np.empty(width)
    net, weights = np.empty(control_m.shape[2]), np.ascontiguousarray(values_u.T)
    n = 0
    for y in range(height):
        squares[:] = 0.0
        first = starts_v[y]
        for c in range(3):
            for k in range(net.size):
                net[k] = 0.0
                for i in range(4):
                    net[k] += values_v[y, i] * control_m[c, first + i, k]
            along = points_m[c, top + y, left : left + width]
            for x in range(width):
                off[x] = along[x]
            begin = 0
            while begin < width:
                start, end = starts_u[begin], begin + 1
                while end < width and starts_u[end] == start:
                    end += 1
                for j in range(4):
                    value, weight, part = net[start + j], weights[j, begin:end], off[begin:end]
                    for x in range(end - begin):
                        part[x] -= value * weight[x]
                begin = end
            for x in range(width):
                squares[x] += off[x] * off[x]
        for x in range(width):
            if mask[y, x]:
                distances[n] = np.sqrt(squares[x])
                n += 1
    return distances


__all__ = ["spline_distances"]
