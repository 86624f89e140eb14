"""B-splines along one axis: knots for pixels in a row, basis functions and their derivatives."""

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import F64, compiled, inlined

#: The paper's surfaces are cubic in both directions.
CUBIC = 3
#: The ten products of two of the four functions on a span.
FIRST = (0, 0, 0, 0, 1, 1, 1, 2, 2, 3)
SECOND = (0, 1, 2, 3, 1, 2, 3, 2, 3, 3)

#: The values of the four cubic functions that are not 0 at a position.
Four = tuple[float, float, float, float]


def basis_matrices(
    knots: NDArray[np.float64], degree: int, parameters: NDArray[np.float64], orders: int = 1
) -> NDArray[np.float64]:
    """Evaluate every basis function, and its first derivatives, at every parameter.

    Parameters
    ----------
    knots : (count + degree + 1,) float64
        Ascending knot vector.
    degree : int
        Of the basis functions.
    parameters : (M,) float64
        Where to evaluate. Outside of the domain the end spans are extrapolated.
    orders : int
        Number of the orders of derivatives: 1 for the functions alone.

    Returns
    -------
    (orders, M, count) float64
        Values, in one over the parameter's unit to the power of the order.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, eq. 2.5 and 2.7.
    """
    count = knots.size - degree - 1
    domain = knots[degree : count + 1]
    last_span = int(np.searchsorted(domain, domain[-1], side="left")) - 1
    span = np.searchsorted(domain, parameters, side="right") - 1
    span = np.clip(span, 0, max(last_span, 0)) + degree
    values = [np.zeros((parameters.size, knots.size - 1))]
    values[0][np.arange(parameters.size), span] = 1.0
    t = parameters[:, np.newaxis]
    for p in range(1, degree + 1):
        n = knots.size - 1 - p
        left_width = knots[p : p + n] - knots[:n]
        right_width = knots[p + 1 : p + 1 + n] - knots[1 : 1 + n]
        # 0 / 0 is 0 by the definition of the basis.
        left = np.divide(1.0, left_width, out=np.zeros(n), where=left_width > 0)
        right = np.divide(1.0, right_width, out=np.zeros(n), where=right_width > 0)
        derivatives = [p * (left * value[:, :n] - right * value[:, 1:]) for value in values[: orders - 1]]
        before, after = values[0][:, :n], values[0][:, 1:]
        functions = (t - knots[:n]) * left * before + (knots[p + 1 : p + 1 + n] - t) * right * after
        values = [functions, *derivatives]
    zeros = [np.zeros((parameters.size, count))] * (orders - len(values))
    return np.stack([*values, *zeros])


@inlined
def even_values(t: float) -> Four:
    """Evaluate the four cubic functions on a span of evenly spaced knots, 0 <= t < 1 on the span itself."""
    s = 1.0 - t
    low, high = s * s * s / 6.0, t * t * t / 6.0
    third = 2.0 / 3.0 - t * t * (1.0 - 0.5 * t)
    return low, third, 1.0 - low - third - high, high


@inlined
def even_slopes(t: float, per_spacing: float) -> Four:
    """Evaluate the slopes of `even_values`, for knots that are one over `per_spacing` apart."""
    s = 1.0 - t
    low, third, high = -0.5 * s * s, t * (1.5 * t - 2.0), 0.5 * t * t
    return low * per_spacing, third * per_spacing, -(low + third + high) * per_spacing, high * per_spacing


@inlined
def knot_span(knots: F64, t: float) -> int:
    """Return the span that holds t; the end spans also hold parameters beyond them."""
    span, last = CUBIC, knots.size - CUBIC - 2
    while span < last and knots[span + 1] <= t and knots[span + 1] < knots[last + 1]:
        span += 1
    return span


@inlined
def cubic_functions(knots: F64, span: int, t: float) -> Four:
    """Evaluate the four cubic functions on a span between any knots.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, algorithm A2.2.
    """
    after_1, after_2, after_3 = knots[span + 1] - t, knots[span + 2] - t, knots[span + 3] - t
    before_1, before_2, before_3 = t - knots[span], t - knots[span - 1], t - knots[span - 2]
    # Of degree 1, of degree 2, and these over the widths of their supports.
    a = 1.0 / (after_1 + before_1)
    b, c = after_1 * a / (after_1 + before_2), before_1 * a / (after_2 + before_1)
    d = after_1 * b / (after_1 + before_3)
    e = (before_2 * b + after_2 * c) / (after_2 + before_2)
    f = before_1 * c / (after_3 + before_1)
    return after_1 * d, before_3 * d + after_2 * e, before_2 * e + after_3 * f, before_1 * f


@lru_cache(maxsize=256)
def pixel_knots(size: int, count: int) -> NDArray[np.float64]:
    """Return the knots of a cubic fit to `size` pixels in a row, whose parameters are 0, 1, ..., size - 1.

    All knot spans hold about as many pixels; for a single one the domain is one unit long.

    Parameters
    ----------
    size : int
        Number of pixels, at least 1.
    count : int
        Number of control points: 4, or more but no more than pixels.

    Returns
    -------
    (count + 4,) float64
        Knot vector whose ends are repeated four times; read-only, as it is cached.

    References
    ----------
    .. [1] L. Piegl and W. Tiller, "The NURBS Book", 2nd ed., 1997, eq. 9.68 and 9.69.
    """
    position = np.arange(1, count - CUBIC, dtype=np.float64) * size / (count - CUBIC)
    index = position.astype(np.intp)
    share = position - index
    inner = (1.0 - share) * (index - 1) + share * index
    knots = np.concatenate([np.zeros(CUBIC + 1), inner, np.full(CUBIC + 1, max(size - 1.0, 1.0))])
    knots.flags.writeable = False
    return knots


class SpanBasis(NamedTuple):
    """The four cubic basis functions that are not zero at each of some parameters along an axis.

    Parameters
    ----------
    starts : (M,) intp
        Number of the first of the four functions, ascending; read-only.
    values : (M, 4) float64
        Of the four functions; read-only.
    size : int
        Number of functions.
    """

    starts: NDArray[np.intp]
    values: NDArray[np.float64]
    size: int


@lru_cache(maxsize=256)
def pixel_basis(size: int, count: int) -> SpanBasis:
    """Return the `count` functions of a cubic fit at `size` pixels in a row; cached as `pixel_knots`."""
    knots, parameters = pixel_knots(size, count), np.arange(size, dtype=np.float64)
    domain = knots[CUBIC : count + 1]
    last_span = int(np.searchsorted(domain, domain[-1], side="left")) - 1
    starts = np.clip(np.searchsorted(domain, parameters, side="right") - 1, 0, last_span)
    functions = starts[:, np.newaxis] + np.arange(CUBIC + 1)
    values = np.take_along_axis(basis_matrices(knots, CUBIC, parameters)[0], functions, axis=1)
    starts.flags.writeable = values.flags.writeable = False
    return SpanBasis(starts, values, count)


class Lattice(NamedTuple):
    """The cubic basis functions on evenly spaced knots along both axes, at the grid pixels of an image.

    Products are the ten of two of the four functions that are not zero, then these themselves.

    Parameters
    ----------
    spans_v, spans_u : (h,), (w,) intp
        Number of the knot span that holds each row and each column.
    products_v : (h, 14) float64
        At every row.
    functions_u : (4, w) float64
        The four functions at every column.
    edges_u : (spans + 1,) intp
        First column of each span, and w.
    sums_u : (w + spans, 14) float64
        Sums of products from the first column of span s to the one before x, at ``x + s``.
    """

    spans_v: NDArray[np.intp]
    spans_u: NDArray[np.intp]
    products_v: NDArray[np.float64]
    functions_u: NDArray[np.float64]
    edges_u: NDArray[np.intp]
    sums_u: NDArray[np.float64]


@lru_cache(maxsize=16)
def lattice(shape: tuple[int, int], spacing: float) -> Lattice:
    """Return the functions on a grid of rows and columns; knots are multiples of the spacing, grid pixels."""
    (spans_v, _, products_v), (spans_u, functions_u, products_u) = (_axis(size, spacing) for size in shape)
    edges = np.searchsorted(spans_u, np.arange(spans_u[-1] + 2))
    parts = [products_u[begin:end].cumsum(axis=0) for begin, end in pairwise(edges)]
    sums = np.concatenate([np.pad(part, ((1, 0), (0, 0))) for part in parts])
    return Lattice(spans_v, spans_u, products_v, functions_u, edges, sums)


def _axis(size: int, spacing: float) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Return spans, functions and products along an axis."""
    positions, functions = np.arange(size) / spacing, np.empty((CUBIC + 1, size))
    spans = np.floor(positions).astype(np.intp)
    _fill_even(positions - spans, functions)
    pairs = [functions[i] * functions[j] for i, j in zip(FIRST, SECOND, strict=True)]
    return spans, functions, np.stack([*pairs, *functions], axis=1)


@compiled
def _fill_even(positions: F64, functions: F64) -> None:
    for n in range(positions.size):
        values = even_values(positions[n])
        for k in range(4):
            functions[k, n] = values[k]
