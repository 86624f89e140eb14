"""Least-squares B-spline fits to values on part of a pixel grid, through separable normal equations."""

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray

from nurbseg.common.compiled import F32, F64, Bool, Intp, compiled, inlined_once
from nurbseg.segmentation.surfaces.bspline import FIRST, SECOND, SpanBasis, pixel_basis

#: Added to the diagonal of the normal matrix, as a share of its largest entry. It matters only where the data
#: are not sufficient, and tends to the solution of least norm.
RIDGE_SHARE = 1e-10
_PRODUCTS = len(FIRST)


@compiled
def dot(a: F64, b: F64) -> float:
    """Return the dot product of two rows."""
    total = 0.0
    for n in range(a.size):
        total += a[n] * b[n]
    return total


@inlined_once
def factorize(band: F64) -> bool:
    """Replace a symmetric band by its Cholesky factor.

    Parameters
    ----------
    band : (N, W) float64
        Entry ``[n, k]`` is that of row ``n + k`` and column ``n``; replaced by the factor's, and by one over
        it on the diagonal.

    Returns
    -------
    bool
        False where the matrix is not positive definite.
    """
    size, width = band.shape
    for n in range(size):
        if not band[n, 0] > 0.0:
            return False
        per_pivot = 1.0 / np.sqrt(band[n, 0])
        reach = min(width, size - n)
        band[n, 0] = per_pivot
        for k in range(1, reach):
            band[n, k] *= per_pivot
        # By index: a slice of an array costs as much as ten of these steps.
        for k in range(1, reach):
            factor = band[n, k]
            if factor != 0.0:
                for m in range(reach - k):
                    band[n + k, m] -= factor * band[n, k + m]
    return True


@inlined_once
def substitute(factor: F64, x: F64) -> None:
    """Solve a system in place.

    Parameters
    ----------
    factor : (N, W) float64
        As `factorize` leaves it.
    x : (N,) float64
        The right-hand side, replaced by the solution.
    """
    size, width = factor.shape
    for n in range(size):
        reach = min(width, size - n)
        x[n] *= factor[n, 0]
        value = x[n]
        for k in range(1, reach):
            x[n + k] -= value * factor[n, k]
    for n in range(size - 1, -1, -1):
        reach = min(width, size - n)
        x[n] = (x[n] - dot(factor[n, 1:reach], x[n + 1 : n + reach])) * factor[n, 0]


def fit_control_points(
    values: NDArray[np.float32], mask: NDArray[np.bool_], corner: tuple[int, int], counts: tuple[int, int]
) -> NDArray[np.float64]:
    """Fit the control points of a bicubic spline to values on part of a window of pixels.

    The parameters are the pixels' positions in the window.

    Parameters
    ----------
    values : (C, H, W) float32
        Images to fit; read only where `mask` is set.
    mask : (h, w) bool
        Pixels of the window that have a value, at least one.
    corner : (int, int)
        First row and column of the window.
    counts : (int, int)
        Control points along u (columns of the image) and v (rows of the image).

    Returns
    -------
    (C, nv, nu) float64
        Control values. Where the data are not sufficient, those of least norm about the image's mean over
        the mask, approached by a small ridge.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the values are not finite, so that there is no solution.
    """
    rows, columns = pixel_basis(mask.shape[0], counts[1]), pixel_basis(mask.shape[1], counts[0])
    solved, control = _solve_splines(values, np.ascontiguousarray(mask), corner, rows, columns)
    if not solved:
        raise LinAlgError("the normal equations have no finite solution")
    return control


@compiled
def _solve_splines(
    images: F32, mask: Bool, corner: tuple[int, int], rows: SpanBasis, columns: SpanBasis
) -> tuple[bool, F64]:
    """Fit the control values of bicubic splines to images on part of a window.

    The normal matrix has an entry for every two control points whose functions overlap: a sum over pixels of
    products of two basis functions along each axis. On a row of a span of columns these are ten sums, and
    four for each image; each is used with the ten products of the row's own functions.

    Parameters
    ----------
    images, mask, corner
        As for `fit_control_points`.
    rows, columns : SpanBasis
        At the rows and columns of the window.

    Returns
    -------
    solved : bool
        Whether there is a finite solution.
    control : (C, rows.size, columns.size) float64
        Control values; where the data are not sufficient, about each image's mean over the mask.
    """
    count, nv, nu = images.shape[0], rows.size, columns.size
    # Numbering control points along the direction that has fewer gives the narrower band.
    step_v, step_u = (nu, 1) if nu <= nv else (1, nv)
    size = nv * nu
    reach = min(3 * min(nv, nu) + 3, size - 1)
    # Row n of the band: entries of the normal matrix for n and itself, n + 1, ...
    band = np.zeros((size, reach + 1))
    right = np.zeros((count, size))
    centers = _some_values(images, mask, corner)
    _add_points(images, mask, corner, rows, columns, (step_v, step_u), centers, band, right)
    _center(band, right, centers)
    largest = 0.0
    for n in range(size):
        largest = max(largest, band[n, 0])
    for n in range(size):
        band[n, 0] += RIDGE_SHARE * largest
    control = np.zeros((count, nv, nu))
    solved = factorize(band)
    if not solved:
        return False, control
    for c in range(count):
        substitute(band, right[c])
        for a in range(nv):
            for b in range(nu):
                value = right[c, a * step_v + b * step_u] + centers[c]
                control[c, a, b] = value
                solved &= abs(value) < np.inf
    return solved, control


@inlined_once
def _some_values(images: F32, mask: Bool, corner: tuple[int, int]) -> F64:
    """Return each image's value at the first marked pixel; relative to it, sums lose little to rounding."""
    for y in range(mask.shape[0]):
        for x in range(mask.shape[1]):
            if mask[y, x]:
                return images[:, corner[0] + y, corner[1] + x].astype(np.float64)
    return np.zeros(images.shape[0])


@inlined_once
def _center(band: F64, right: F64, centers: F64) -> None:
    """Make right sides relative to the mean of each image instead of a value, and return the means.

    As the functions sum to 1, a row of the normal matrix sums to its function's sum over the points, and a
    right side to its image's.
    """
    size, width = band.shape
    ones, points = np.zeros(size), 0.0
    for n in range(size):
        own = band[n, 0]
        for k in range(1, min(width, size - n)):
            own += band[n, k]
            ones[n + k] += band[n, k]
        ones[n] += own
        points += ones[n]
    for c in range(right.shape[0]):
        offset = right[c].sum() / points
        centers[c] += offset
        for n in range(size):
            right[c, n] -= offset * ones[n]


@inlined_once
def _add_points(
    images: F32,
    mask: Bool,
    corner: tuple[int, int],
    rows: SpanBasis,
    columns: SpanBasis,
    steps: tuple[int, int],
    centers: F64,
    band: F64,
    right: F64,
) -> None:
    """Add the sums over points to the normal matrix and the right sides."""
    height, width = mask.shape
    top, left, count = np.uint32(corner[0]), np.uint32(corner[1]), images.shape[0]
    edges, spans = span_edges(columns.starts)
    # Products of two functions at every column, and their sums over whole spans.
    along, products = np.ascontiguousarray(columns.values.T), np.empty((_PRODUCTS, width))
    whole = np.zeros((spans, _PRODUCTS))
    for k in range(_PRODUCTS):
        first, second, product = along[FIRST[k]], along[SECOND[k]], products[k]
        for x in range(width):
            product[x] = first[x] * second[x]
        for s in range(spans):
            whole[s, k] = product[edges[s] : edges[s + 1]].sum()
    weight, shifted = np.empty(width), np.empty((count, width))
    sums, moments = np.empty(_PRODUCTS), np.empty(4)
    # Sums over all rows of one span of rows, by span of columns.
    matrix, inner = np.zeros((spans, _PRODUCTS, _PRODUCTS)), np.zeros((spans, _PRODUCTS))
    sides = np.zeros((spans, count, 4, 4))
    for y in range(height):
        marked = mask[y]
        for x in range(width):
            weight[x] = np.float64(marked[x])
        for c in range(count):
            image, center, row = images[c, top + y, left : left + width], centers[c], shifted[c]
            for x in range(width):
                # Subtracted everywhere, so that the loop has no branch.
                value = np.float64(image[x]) - center
                row[x] = value if marked[x] else 0.0
        own = rows.values[y]
        for s in range(spans):
            begin, end = edges[s], edges[s + 1]
            # Slices are taken where they are used: elsewhere each would count references to its array.
            points = weight[begin:end].sum()
            if points == 0.0:
                continue
            if points == end - begin:
                # All such rows have the same sums, which are used once for all.
                for k in range(_PRODUCTS):
                    inner[s, k] += own[FIRST[k]] * own[SECOND[k]]
            else:
                for k in range(_PRODUCTS):
                    sums[k] = dot(weight[begin:end], products[k, begin:end])
                for k in range(_PRODUCTS):
                    product_v = own[FIRST[k]] * own[SECOND[k]]
                    for m in range(_PRODUCTS):
                        matrix[s, k, m] += product_v * sums[m]
            for c in range(count):
                for j in range(4):
                    moments[j] = dot(shifted[c, begin:end], along[j, begin:end])
                for i in range(4):
                    for j in range(4):
                        sides[s, c, i, j] += own[i] * moments[j]
        if y + 1 == height or rows.starts[y + 1] != rows.starts[y]:
            for s in range(spans):
                for k in range(_PRODUCTS):
                    for m in range(_PRODUCTS):
                        matrix[s, k, m] += inner[s, k] * whole[s, m]
                origin = np.uint32(rows.starts[y] * steps[0] + columns.starts[edges[s]] * steps[1])
                scatter(matrix, s, origin, steps, band)
                for c in range(count):
                    for i in range(4):
                        for j in range(4):
                            right[c, np.uint32(origin + i * steps[0] + j * steps[1])] += sides[s, c, i, j]
            matrix[:] = 0.0
            inner[:] = 0.0
            sides[:] = 0.0


@compiled
def span_edges(starts: Intp) -> tuple[Intp, int]:
    """Return the positions at which the functions change, with both ends, and the number of spans."""
    edges = np.empty(starts.size + 1, dtype=np.intp)
    edges[0] = 0
    spans = 1
    for x in range(1, starts.size):
        if starts[x] != starts[x - 1]:
            edges[spans] = x
            spans += 1
    edges[spans] = starts.size
    return edges, spans


@inlined_once
def scatter(matrix: F64, cell: int, origin: np.uint32, steps: tuple[int, int], band: F64) -> None:
    """Add the products of functions in one cell, whose first control point is number `origin`, to a band."""
    step_v, step_u = np.uint32(steps[0]), np.uint32(steps[1])
    for k in range(_PRODUCTS):
        i, p = FIRST[k], SECOND[k]
        for m in range(_PRODUCTS):
            j, q = FIRST[m], SECOND[m]
            # p is no less than i, and q than j.
            band[origin + i * step_v + j * step_u, (p - i) * step_v + (q - j) * step_u] += matrix[cell, k, m]
            if i != p and j != q:
                n = origin + i * step_v + q * step_u
                other = origin + p * step_v + j * step_u
                band[min(n, other), np.uint32(max(n, other) - min(n, other))] += matrix[cell, k, m]
