"""Cubic bases of one window, on evenly spaced knots that all segments of an image share."""

import numpy as np

from nurbseg.drivers.compiled import F64, compiled
from nurbseg.segmentation.surfaces.bspline import CUBIC, SpanBasis, even_values


@compiled
def lattice_basis(start: int, stop: int, margin: int, spacing: float) -> tuple[SpanBasis, F64]:
    """Return the functions that reach a window or a margin around it.

    Parameters
    ----------
    start, stop : int
        First grid pixel of the window along the axis, and one past the last.
    margin : int
        How far splines of these functions extend beyond the window on both sides, grid pixels.
    spacing : float
        Distance of the knots, grid pixels; the knots are its multiples.

    Returns
    -------
    basis : SpanBasis
        At the grid pixels of the window alone.
    knots : (count + 4,) float64
        Knot vector, grid pixels.
    """
    # Function number i is not zero between knots i - 3 and i + 1.
    first = int((start - margin) // spacing)
    count = int((stop - 1 + margin) // spacing) - first + CUBIC + 1
    starts, values = np.empty(stop - start, dtype=np.intp), np.empty((stop - start, CUBIC + 1))
    for n in range(stop - start):
        position = (start + n) / spacing
        span = np.floor(position)
        starts[n] = int(span) - first
        values[n, 0], values[n, 1], values[n, 2], values[n, 3] = even_values(position - span)
    knots = np.empty(count + CUBIC + 1)
    for k in range(knots.size):
        knots[k] = spacing * (first - CUBIC + k)
    return SpanBasis(starts, values, count), knots
