"""Lines of constant parameter on the fitted surfaces, along the rows and columns of their lattices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.view.drawing.surface_samples import Lattices


def isolines(
    lattices: Lattices, row_of: NDArray[np.int64], every: int
) -> tuple[NDArray[np.uint32], NDArray[np.intp]]:
    """Return the lines of constant v, then those of constant u, broken where a surface is trimmed.

    Parameters
    ----------
    lattices : Lattices
        Of the surfaces.
    row_of : (V,) int64
        Row of each of the lattices' vertices among those that are kept, -1 for the others.
    every : int
        Which rows and columns of a lattice are lines; a lattice of fewer has one near its middle.

    Returns
    -------
    rows : (N,) uint32
        Rows of the kept vertices, line after line.
    sizes : (L,) intp
        Vertices of each line, at least two.
    """
    rows, columns = lattices.count.T
    surface = np.repeat(np.arange(rows.size), rows * columns)
    place = np.arange(surface.size) - lattices.start[surface]
    row, column = np.divmod(place, columns[surface])
    lines, sizes = [], []
    for line, number, order in ((row, rows, place), (column, columns, column * rows[surface] + row)):
        first = np.minimum(every, number - 1) // 2
        chosen = np.flatnonzero((row_of >= 0) & (line % every == first[surface]))
        # Neighbours on a line follow each other; between two surfaces a number is left out.
        key = (lattices.start + np.arange(rows.size))[surface[chosen]] + order[chosen]
        in_order = np.argsort(key)
        chosen, key = chosen[in_order], key[in_order]
        ends = np.flatnonzero(np.diff(key) != 1) + 1
        of_line = np.diff(ends, prepend=0, append=chosen.size)
        lines.append(row_of[chosen][np.repeat(of_line > 1, of_line)])
        sizes.append(of_line[of_line > 1])
    return np.concatenate(lines).astype(np.uint32), np.concatenate(sizes)
