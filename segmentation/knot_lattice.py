"""Cubic bases on evenly spaced knots that all segments of an image share, cut out for one window."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.bspline import CUBIC, basis_matrix

#: Tables are made for whole multiples of so many places.
_TABLE_PLACES = 160


@dataclass(frozen=True, slots=True, eq=False)
class LatticeBasis:
    """The basis functions that reach a window, along one axis.

    Parameters
    ----------
    spacing : float
        Distance of the knots, places; the knots are its multiples.
    first : int
        Number of the first function; that of number i is not zero between knots i - 3 and i + 1.
    values : (M, count) float64
        Of the functions at the places of the window.
    products : (M, 4 * count) float64
        Column ``k * count + i`` is the product of functions ``first + i`` and ``first + i + k``.
    """

    spacing: float
    first: int
    values: NDArray[np.float64]
    products: NDArray[np.float64]

    @property
    def count(self) -> int:
        """Number of functions."""
        return int(self.values.shape[1])

    @property
    def knots(self) -> NDArray[np.float64]:
        """Knot vector, (count + 4,) float64, places."""
        return self.spacing * np.arange(self.first - CUBIC, self.first + self.count + 1, dtype=np.float64)


@lru_cache(maxsize=512)
def lattice_basis(start: int, stop: int, margin: int, spacing: float) -> LatticeBasis:
    """Return the functions that reach a window or a margin around it.

    Parameters
    ----------
    start, stop : int
        First place of the window along the axis, and one past the last.
    margin : int
        How much farther a spline of these functions shall go on in both directions, places.
    spacing : float
        Distance of the knots, places.

    Returns
    -------
    LatticeBasis
        Values and products at the places of the window alone.
    """
    first = int(np.floor((start - margin) / spacing))
    count = int(np.floor((stop - 1 + margin) / spacing)) - first + CUBIC + 1
    # Functions beyond the places of the window are zero there.
    lowest, values, products = _table(spacing, -(-stop // _TABLE_PLACES), -(-(margin + 1) // _TABLE_PLACES))
    functions = slice(first - lowest, first - lowest + count)
    rows = slice(start, stop)
    return LatticeBasis(
        spacing, first, values[rows, functions], products[rows, :, functions].reshape(stop - start, -1)
    )


@lru_cache(maxsize=16)
def _table(
    spacing: float, blocks: int, margin_blocks: int
) -> tuple[int, NDArray[np.float64], NDArray[np.float64]]:
    """Tabulate the functions of an image's whole extent: number of the first, values, and products."""
    places = np.arange(blocks * _TABLE_PLACES, dtype=np.float64)
    margin = margin_blocks * _TABLE_PLACES
    lowest = int(np.floor(-margin / spacing))
    count = int(np.floor((places[-1] + margin) / spacing)) - lowest + CUBIC + 1
    knots = spacing * np.arange(lowest - CUBIC, lowest + count + 1, dtype=np.float64)
    values = basis_matrix(knots, CUBIC, places)
    products = np.zeros((places.size, CUBIC + 1, count))
    for k in range(CUBIC + 1):
        np.multiply(values[:, : count - k], values[:, k:], out=products[:, k, : count - k])
    values.flags.writeable = False
    products.flags.writeable = False
    return lowest, values, products


__all__ = ["LatticeBasis", "lattice_basis"]
