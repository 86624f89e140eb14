"""Least-squares B-spline fits of least norm, by the singular values of a reduced design matrix."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray
from scipy.linalg import lstsq

from nurbseg.segmentation.surfaces.bspline import CUBIC, SpanBasis, pixel_basis
from nurbseg.segmentation.surfaces.leastsquares import span_edges


def minimum_norm_control_points(
    values: NDArray[np.float32], mask: NDArray[np.bool_], corner: tuple[int, int], counts: tuple[int, int]
) -> NDArray[np.float64]:
    """Fit the control points of a bicubic spline to values on part of a window of pixels, by SVD.

    The parameters are the pixels' positions in the window. The design matrix has a row for each pixel. Its
    triangular factor has the same singular values, the smallest of which would be lost in the normal matrix.
    Householder reflections make it of the pixels of one span of rows and columns, and then of those of one
    span of rows, as no others share their control points.

    Parameters
    ----------
    values, mask, corner
        As for `nurbseg.segmentation.surfaces.leastsquares.fit_control_points`.
    counts : (int, int)
        As there; beyond 4 at most the number of pixels, so that every knot span holds one.

    Returns
    -------
    (C, nv, nu) float64
        Control values: the least-squares solution of least norm about each image's mean
        over the mask. Singular values count as 0 below the machine epsilon times the greater of the
        numbers of pixels and of control points, times the largest.

    Raises
    ------
    ValueError
        If there are too many control points.
    numpy.linalg.LinAlgError
        If the values are not finite, so that there is no solution.

    References
    ----------
    .. [1] G. H. Golub and C. F. Van Loan, "Matrix Computations", 4th ed., 2013, sections 5.2 and 5.5.
    """
    height, width = mask.shape
    if counts[0] > max(width, CUBIC + 1) or counts[1] > max(height, CUBIC + 1):
        raise ValueError(f"counts: expected at most {(width, height)} control points, got {counts}")
    rows, columns = pixel_basis(height, counts[1]), pixel_basis(width, counts[0])
    window = values[:, corner[0] : corner[0] + height, corner[1] : corner[1] + width]
    centers = window[:, mask].mean(axis=1, dtype=np.float64)
    sides = np.where(mask, window - centers[:, np.newaxis, np.newaxis], 0.0)
    if not np.isfinite(sides).all():
        raise LinAlgError("the values are not finite")
    size = rows.size * columns.size
    factor = _triangular_factor(sides, mask, rows, columns)
    cutoff = float(np.finfo(np.float64).eps) * max(int(np.count_nonzero(mask)), size)
    solution = lstsq(factor[:, :size], factor[:, size:], cond=cutoff, check_finite=False)[0]
    control: NDArray[np.float64] = (solution + centers).T.reshape(-1, rows.size, columns.size)
    return control


def _triangular_factor(
    sides: NDArray[np.float64], mask: NDArray[np.bool_], rows: SpanBasis, columns: SpanBasis
) -> NDArray[np.float64]:
    """Reduce the design matrix, with the right sides (C, h, w) beside it: (nv nu, nv nu + C)."""
    nu, reached, size = columns.size, 4 * columns.size, rows.size * columns.size
    factor = np.zeros((size, size + len(sides)))
    # For the control points that a span of rows reaches: what earlier spans leave of them.
    system = np.zeros((0, reached + len(sides)))
    for y, end_y in _spans(rows.starts):
        parts = [system]
        for x, end_x in _spans(columns.starts):
            marked = mask[y:end_y, x:end_x]
            own = np.einsum("yi,xj->yxij", rows.values[y:end_y], columns.values[x:end_x])[marked]
            cell = np.column_stack([own.reshape(-1, 16), sides[:, y:end_y, x:end_x][:, marked].T])
            cell = np.asarray(np.linalg.qr(cell, mode="r"))[:16]
            part = np.zeros((len(cell), 4, nu))
            part[:, :, columns.starts[x] : columns.starts[x] + 4] = cell[:, :16].reshape(-1, 4, 4)
            parts.append(np.column_stack([part.reshape(-1, reached), cell[:, 16:]]))
        system = np.asarray(np.linalg.qr(np.concatenate(parts), mode="r"))[:reached]
        # The first of four rows of control points is finished: the next span of rows begins at the second.
        done, first = system[: nu if end_y < len(mask) else reached], rows.starts[y] * nu
        factor[first : first + len(done), first : first + reached] = done[:, :reached]
        factor[first : first + len(done), size:] = done[:, reached:]
        left = system[nu:]
        system = np.column_stack([left[:, nu:reached], np.zeros((len(left), nu)), left[:, reached:]])
    return factor


def _spans(starts: NDArray[np.intp]) -> Iterator[tuple[int, int]]:
    """Return the first position of every span, and one past its last."""
    edges, count = span_edges(starts)
    return pairwise(edges[: count + 1].tolist())
