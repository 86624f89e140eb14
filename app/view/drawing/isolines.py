"""Lines of constant parameter on the fitted surfaces, along rows and columns of their lattices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nurbseg.app.view.drawing.surface_samples import Lattices


def isolines(
    lattices: Lattices, row_of: NDArray[np.int64], every: int
) -> tuple[NDArray[np.uint32], NDArray[np.intp]]:
    """Return the lines of constant v, then those of constant u, interrupted where a surface is trimmed.

    Parameters
    ----------
    lattices : Lattices
        Of the surfaces.
    row_of : (V,) int64
        Row of each lattice vertex among the kept vertices; -1 for the others.
    every : int
        Distance of lines in rows or columns of a lattice; a smaller lattice has one line near its middle.

    Returns
    -------
    rows : (N,) uint32
        Rows of the kept vertices, line after line.
    sizes : (L,) intp
        Number of vertices of each line, at least two.
    """
    rows, columns = lattices.count.T
    surface = np.repeat(np.arange(rows.size), rows * columns)
    place = np.arange(surface.size) - lattices.start[surface]
    row, column = np.divmod(place, columns[surface])
    lines, sizes = [], []
    for line, number, order in ((row, rows, place), (column, columns, column * rows[surface] + row)):
        first = np.minimum(every, number - 1) // 2
        chosen = np.flatnonzero((row_of >= 0) & (line % every == first[surface]))
        # Keys of neighbours on a line are consecutive; between two surfaces one is left out.
        key = (lattices.start + np.arange(rows.size))[surface[chosen]] + order[chosen]
        in_order = np.argsort(key)
        chosen, key = chosen[in_order], key[in_order]
        ends = np.flatnonzero(np.diff(key) != 1) + 1
        of_line = np.diff(ends, prepend=0, append=chosen.size)
        lines.append(row_of[chosen][np.repeat(of_line > 1, of_line)])
        sizes.append(of_line[of_line > 1])
    return np.concatenate(lines).astype(np.uint32), np.concatenate(sizes)
