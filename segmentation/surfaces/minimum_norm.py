"""Least-squares B-spline fits of least norm, by the singular values of a reduced design matrix."""

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray
from scipy.linalg import lstsq

from nurbseg.common.compiled import F32, F64, Bool, Intp, compiled
from nurbseg.segmentation.surfaces.bspline import CUBIC, SpanBasis, pixel_basis


def minimum_norm_control_points(
    values: NDArray[np.float32], mask: NDArray[np.bool_], corner: tuple[int, int], counts: tuple[int, int]
) -> NDArray[np.float64]:
    """Fit the control points of a bicubic spline to values on part of a window of pixels, by SVD.

    The parameters are the pixels' positions in the window. The design matrix has a row for each pixel. Its
    triangular factor has the same singular values, the smallest of which would be lost in the normal matrix.
    Householder reflections make it of the pixels of one row of one span, of one span of rows and columns, and
    of one span of rows, as no others share their control points.

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
    size = rows.size * columns.size
    factor = _triangular_factor(window, np.ascontiguousarray(mask), rows, columns, centers)
    if not np.isfinite(factor).all():
        raise LinAlgError("the values are not finite")
    cutoff = float(np.finfo(np.float64).eps) * max(int(np.count_nonzero(mask)), size)
    solution = lstsq(factor[:, :size], factor[:, size:], cond=cutoff, check_finite=False)[0]
    control: NDArray[np.float64] = (solution + centers).T.reshape(-1, rows.size, columns.size)
    return control


@compiled
def _triangular_factor(images: F32, mask: Bool, rows: SpanBasis, columns: SpanBasis, centers: F64) -> F64:
    """Reduce the design matrix, with the images less their centers beside it: (nv nu, nv nu + C)."""
    height, width = mask.shape
    nu = columns.size
    count, reached, size = centers.size, 4 * nu, rows.size * nu
    factor = np.zeros((size, size + count))
    # Rows for the control points that a span of rows reaches: first what earlier spans leave of them.
    system = np.empty((reached + 16 * nu, reached + count))
    system[:reached] = 0.0
    y = 0
    while y < height:
        end_y = _end_of_span(rows.starts, y)
        used, x = reached, 0
        while x < width:
            end_x = _end_of_span(columns.starts, x)
            cell = _cell(
                images[:, y:end_y, x:end_x],
                mask[y:end_y, x:end_x],
                rows.values[y:end_y],
                columns.values[x:end_x],
                centers,
            )
            for row in cell:
                target = system[used]
                target[:] = 0.0
                for i in range(4):
                    for j in range(4):
                        target[i * nu + columns.starts[x] + j] = row[4 * i + j]
                target[reached:] = row[16:]
                used += 1
            x = end_x
        _triangularize(system[:used], reached)
        # The first of four rows of control points is finished: the next span of rows begins at the second.
        _put(system, nu if end_y < height else reached, factor, rows.starts[y] * nu)
        _move_up(system, nu, reached)
        y = end_y
    return factor


@compiled
def _end_of_span(starts: Intp, begin: int) -> int:
    """Return one past the last position with the functions of the first."""
    end = begin + 1
    while end < starts.size and starts[end] == starts[begin]:
        end += 1
    return end


@compiled
def _cell(images: F32, mask: Bool, values_v: F64, values_u: F64, centers: F64) -> F64:
    """Reduce the rows of the pixels of one span of rows and columns, to 16 functions at most: (M, 16 + C)."""
    height, width = mask.shape
    count = centers.size
    cell, run = np.empty((4 * height, 16 + count)), np.empty((width, 4 + count))
    used = 0
    for y in range(height):
        points = 0
        for x in range(width):
            if mask[y, x]:
                run[points, :4] = values_u[x]
                for c in range(count):
                    run[points, 4 + c] = np.float64(images[c, y, x]) - centers[c]
                points += 1
        _triangularize(run[:points], 4)
        for n in range(min(points, 4)):
            for i in range(4):
                for j in range(4):
                    cell[used, 4 * i + j] = values_v[y, i] * run[n, j]
            cell[used, 16:] = run[n, 4:]
            used += 1
    _triangularize(cell[:used], 16)
    return cell[: min(used, 16)]


@compiled
def _put(system: F64, rows: int, factor: F64, first: int) -> None:
    """Write the first rows of a reduced system whose first control point is number `first`."""
    count = factor.shape[1] - factor.shape[0]
    reached = system.shape[1] - count
    for n in range(rows):
        factor[first + n, first : first + reached] = system[n, :reached]
        factor[first + n, factor.shape[0] :] = system[n, reached:]


@compiled
def _move_up(system: F64, rows: int, reached: int) -> None:
    """Drop the first control points of a reduced system, and append as many new ones."""
    for n in range(reached):
        for m in range(reached):
            inside = n + rows < reached and m + rows < reached
            system[n, m] = system[n + rows, m + rows] if inside else 0.0
        for m in range(reached, system.shape[1]):
            system[n, m] = system[n + rows, m] if n + rows < reached else 0.0


@compiled
def _triangularize(A: F64, columns: int) -> None:
    """Make the first columns upper triangular by Householder reflections of the rows, in place."""
    rows, width = A.shape
    dots = np.empty(width)
    for k in range(min(rows - 1, columns)):
        square = 0.0
        for i in range(k + 1, rows):
            square += A[i, k] * A[i, k]
        if square == 0.0:
            continue
        # The reflection that takes the column x to (alpha, 0, ...) is 1 - beta v v^T, v along x - alpha e.
        head = A[k, k]
        alpha = np.sqrt(head * head + square)
        if head > 0.0:
            alpha = -alpha
        first = head - alpha
        beta = -first / alpha
        A[k, k] = alpha
        for m in range(k + 1, width):
            dots[m] = A[k, m]
        for i in range(k + 1, rows):
            v = A[i, k] / first
            A[i, k] = v
            if v != 0.0:
                for m in range(k + 1, width):
                    dots[m] += v * A[i, m]
        for m in range(k + 1, width):
            dots[m] *= beta
            A[k, m] -= dots[m]
        for i in range(k + 1, rows):
            v = A[i, k]
            if v != 0.0:
                for m in range(k + 1, width):
                    A[i, m] -= v * dots[m]
            A[i, k] = 0.0
