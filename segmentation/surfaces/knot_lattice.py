"""Cubic bases of one window, on evenly spaced knots that all segments of an image share."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.surfaces.bspline import CUBIC, SpanBasis, even_functions

#: Tables cover multiples of this many grid pixels.
_TABLE_PIXELS = 160


def lattice_basis(
    start: int, stop: int, margin: int, spacing: float
) -> tuple[SpanBasis, NDArray[np.float64]]:
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
    spans, values, lowest, knots = _table(spacing, margin, -(-stop // _TABLE_PIXELS))
    before = first - CUBIC - lowest
    starts = spans[start:stop] - first
    starts.flags.writeable = False
    return SpanBasis(starts, values[start:stop], count), knots[before : before + count + CUBIC + 1]


@lru_cache(maxsize=16)
def _table(
    spacing: float, margin: int, blocks: int
) -> tuple[NDArray[np.intp], NDArray[np.float64], int, NDArray[np.float64]]:
    """Tabulate span and functions at every grid pixel of an image's extent; give the lowest knot, and all."""
    pixels = blocks * _TABLE_PIXELS
    position = np.arange(pixels, dtype=np.float64) / spacing
    span = np.floor(position)
    values = even_functions(position - span, spacing)
    lowest = int(-margin // spacing) - CUBIC
    knots = spacing * np.arange(lowest, int((pixels - 1 + margin) // spacing) + CUBIC + 2, dtype=np.float64)
    for table in (values, knots):
        table.flags.writeable = False
    return span.astype(np.intp), values, lowest, knots
