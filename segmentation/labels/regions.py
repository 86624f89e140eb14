"""Connected components of labels; a gap in depth separates neighbours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nurbseg.drivers.compiled import F32, I32, Bool, Intp, compiled
from nurbseg.segmentation.labels.spreading import spread_in_place


@dataclass(frozen=True, slots=True, eq=False)
class PixelAdjacency:
    """Which neighbours on a pixel grid have no gap in depth between them.

    Parameters
    ----------
    right : (h, w) bool
        Whether a grid pixel is connected to the one to its right; False in the last column.
    down : (h, w) bool
        Whether it is connected to the one below; False in the last row.
    """

    right: NDArray[np.bool_]
    down: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """Connected components of equal label, numbered from 1 in the order of their first grid pixels.

    Parameters
    ----------
    numbers : (h, w) int32
        Number of each grid pixel's component; 0 where the label is 0.
    labels_of : (count + 1,) int32
        Label of each component; 0 for number 0.
    sizes : (count + 1,) intp
        Grid pixels of each component; 0 for number 0.
    """

    numbers: NDArray[np.int32]
    labels_of: NDArray[np.int32]
    sizes: NDArray[np.intp]

    def large(self, grid_pixels_min: float, keep: int) -> NDArray[np.bool_]:
        """Return which components have enough grid pixels or are the largest of a label up to `keep`."""
        kept = self.sizes >= grid_pixels_min
        # In ascending order of size, so that the largest component of each label is written last.
        order = np.argsort(self.sizes, kind="stable")
        largest = np.zeros(max(keep, int(self.labels_of.max())) + 1, dtype=np.intp)
        largest[self.labels_of[order]] = order
        kept[largest[1 : keep + 1]] = True
        kept[0] = False
        return kept


def pixel_adjacency(
    inverse_depth: NDArray[np.float32], valid: NDArray[np.bool_], gap_per_m: float
) -> PixelAdjacency:
    """Connect neighbours whose inverse depths differ by less than a gap.

    Parameters
    ----------
    inverse_depth : (h, w) float32
        One over depth, 1/m.
    valid : (h, w) bool
        Where there is a point.
    gap_per_m : float
        Smallest gap, 1/m.

    Returns
    -------
    PixelAdjacency
        Between points only.
    """
    adjacency = PixelAdjacency(np.empty(valid.shape, dtype=np.bool_), np.empty(valid.shape, dtype=np.bool_))
    _connect_neighbors(
        np.ascontiguousarray(inverse_depth),
        np.ascontiguousarray(valid),
        np.float32(gap_per_m),
        adjacency.right,
        adjacency.down,
    )
    return adjacency


@compiled
def _connect_neighbors(
    inverse_depth: F32, valid: Bool, gap_per_m: np.float32, right: Bool, down: Bool
) -> None:
    height, width = valid.shape
    for row in range(height):
        for column in range(width - 1):
            step = abs(inverse_depth[row, column + 1] - inverse_depth[row, column])
            right[row, column] = (step < gap_per_m) & valid[row, column] & valid[row, column + 1]
        right[row, width - 1] = False
    for row in range(height - 1):
        for column in range(width):
            step = abs(inverse_depth[row + 1, column] - inverse_depth[row, column])
            down[row, column] = (step < gap_per_m) & valid[row, column] & valid[row + 1, column]
    down[height - 1] = False


def connected_components(labels: NDArray[np.int32], adjacency: PixelAdjacency) -> Components:
    """Find the components of equal label that are connected through adjacent grid pixels.

    Parameters
    ----------
    labels : (h, w) int32
        0 belongs to no component.
    adjacency : PixelAdjacency
        Of the same grid.

    Returns
    -------
    Components
        All of them, however small.
    """
    grid_pixels = np.flatnonzero(labels > 0)
    return _connected(
        grid_pixels, labels.reshape(-1).take(grid_pixels).astype(np.int32, copy=False), adjacency
    )


def _connected(
    grid_pixels: NDArray[np.intp], labels: NDArray[np.int32], adjacency: PixelAdjacency
) -> Components:
    """Find the components of some flat grid pixels, ascending, that have a label."""
    numbers = np.zeros(adjacency.right.shape, dtype=np.int32)
    labels_of, sizes = (
        np.empty(grid_pixels.size + 1, dtype=np.int32),
        np.empty(grid_pixels.size + 1, dtype=np.intp),
    )
    count = _connect(grid_pixels, labels, adjacency.right, adjacency.down, numbers, labels_of, sizes)
    return Components(numbers, labels_of[: count + 1].copy(), sizes[: count + 1].copy())


@compiled
def _root(parents: I32, number: int) -> int:
    while parents[number] != number:
        parents[number] = parents[parents[number]]
        number = parents[number]
    return number


@compiled
def _connect(
    grid_pixels: Intp, labels: I32, right: Bool, down: Bool, numbers: I32, labels_of: I32, sizes: Intp
) -> int:
    """Find components, and return how many there are.

    Union-find: a grid pixel takes the number of an earlier neighbour; where two components meet, the
    smaller number becomes the parent of the larger one.
    """
    width = right.shape[1]
    number_of, linked_right, linked_down = numbers.reshape(-1), right.reshape(-1), down.reshape(-1)
    parents = np.empty(grid_pixels.size + 1, dtype=np.int32)
    parents[0] = labels_of[0] = sizes[0] = 0
    count = 0
    number, size = 0, 0
    for n in range(grid_pixels.size):
        pixel, label, before = grid_pixels[n], labels[n], number
        # Nothing is connected across the ends of rows; number 0 is of no label.
        if not (
            pixel > 0
            and linked_right[pixel - 1]
            and grid_pixels[n - 1] == pixel - 1
            and labels[n - 1] == label
        ):
            number = 0
        if pixel >= width and linked_down[pixel - width]:
            above = number_of[pixel - width]
            if above != number and labels_of[above] == label:
                if number == 0:
                    number = above
                else:
                    one, other = _root(parents, number), _root(parents, above)
                    number = min(one, other)
                    parents[max(one, other)] = number
        if number == 0:
            count += 1
            number = count
            parents[number], labels_of[number], sizes[number] = number, label, 0
        number_of[pixel] = number
        if number != before:
            sizes[before] += size
            size = 0
        size += 1
    sizes[number] += size
    sizes[0] = 0
    # A parent has a smaller number, so it is final already.
    last = 0
    for number in range(1, count + 1):
        if parents[number] == number:
            last += 1
            labels_of[last], sizes[last] = labels_of[number], sizes[number]
            parents[number] = last
        else:
            parents[number] = parents[parents[number]]
            sizes[parents[number]] += sizes[number]
    if last < count:
        for pixel in grid_pixels:
            number_of[pixel] = parents[number_of[pixel]]
    return last


def large_components(
    grid_pixels: NDArray[np.intp],
    labels: NDArray[np.int32],
    adjacency: PixelAdjacency,
    inverse_depth: NDArray[np.float32],
    *,
    gap_per_m: float,
    grid_pixels_min: float,
) -> tuple[list[NDArray[np.intp]], list[int]]:
    """Find the connected components that are large enough, and spread them over the small ones.

    Parameters
    ----------
    grid_pixels : (N,) intp
        Flat indices of grid pixels, ascending; at least one.
    labels : (N,) int32
        Label of each, more than 0.
    adjacency, inverse_depth : PixelAdjacency, (h, w) float32
        Of the whole grid.
    gap_per_m : float
        Smallest gap, 1/m.
    grid_pixels_min : float
        Smallest number of grid pixels of a component.

    Returns
    -------
    components : list of (n,) intp
        Grid pixels of each component kept, ascending; empty if none is large enough.
    labels_of : list of int
        Label of each component.
    """
    # Only the rows that hold grid pixels are looked at.
    width = adjacency.right.shape[1]
    rows = slice(int(grid_pixels[0]) // width, int(grid_pixels[-1]) // width + 1)
    at = grid_pixels - rows.start * width
    found = _connected(at, labels, PixelAdjacency(adjacency.right[rows], adjacency.down[rows]))
    kept = np.flatnonzero(found.sizes[1:] >= grid_pixels_min) + 1
    if not kept.size:
        return [], []
    if kept.size + 1 < found.sizes.size:
        number = np.zeros(found.sizes.size, dtype=np.int32)
        number[kept] = np.arange(1, kept.size + 1)
        unassigned = np.empty_like(at)
        count = _renumber(at, number, found.numbers, unassigned)
        spread_in_place(found.numbers, unassigned[:count], inverse_depth[rows], gap_per_m)
    if kept.size == 1:
        return [grid_pixels], found.labels_of[kept].tolist()
    grouped, ends = np.empty_like(grid_pixels), np.zeros(kept.size + 2, dtype=np.intp)
    _group(grid_pixels, at, found.numbers, grouped, ends)
    pieces = [grouped[ends[n - 1] : ends[n]] for n in range(1, kept.size + 1)]
    return pieces, found.labels_of[kept].tolist()


@compiled
def _renumber(grid_pixels: Intp, number: I32, numbers: I32, unassigned: Intp) -> int:
    """Renumber components; list grid pixels whose component is dropped, and return how many there are."""
    number_of = numbers.reshape(-1)
    count = 0
    for pixel in grid_pixels:
        number_of[pixel] = number[number_of[pixel]]
        if number_of[pixel] == 0:
            unassigned[count] = pixel
            count += 1
    return count


@compiled
def _group(grid_pixels: Intp, at: Intp, numbers: I32, grouped: Intp, ends: Intp) -> None:
    """Sort grid pixels by the number at each, from 1 on; `ends`, zeros, becomes where each number ends."""
    number_of = numbers.reshape(-1)
    for n in range(grid_pixels.size):
        ends[number_of[at[n]] + 1] += 1
    for n in range(1, ends.size):
        ends[n] += ends[n - 1]
    for n in range(grid_pixels.size):
        number = number_of[at[n]]
        grouped[ends[number]] = grid_pixels[n]
        ends[number] += 1
