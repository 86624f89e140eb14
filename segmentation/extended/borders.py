"""Refinement of borders at full resolution: pixels go to the surface that explains them best."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nurbseg.common.compiled import F32, I32, Bool, Intp, compiled
from nurbseg.segmentation.config import REFERENCE_PIXELS, SegmentationConfig
from nurbseg.segmentation.labels.images import label_sizes
from nurbseg.segmentation.labels.regions import connected_components, pixel_adjacency
from nurbseg.segmentation.labels.spreading import spread_labels
from nurbseg.segmentation.surfaces.metrics import SQUARE_MOST
from nurbseg.segmentation.surfaces.surface_table import Splines, SurfaceTable, spline_at

#: Largest distance of neighbors that vote, along rows and columns, pixels.
_REACH = 2
#: Weight of one neighbor at a distance of one pixel against a squared residual in units of the noise.
_VOTE = 0.7
#: Vote of a neighbor across a gap in depth, relative to others.
ACROSS_GAP = 0.25
#: Margins below this may be due to rounding.
_ROUNDING = np.float32(1e-3)
#: Passes over the pixels at borders.
_SWEEPS = 4
#: Pixels within reach along a row or column, and of the square around a pixel with its own.
_SIDE = 2 * _REACH + 1
_AROUND = _SIDE * _SIDE
_DISTANCES = np.hypot(*np.mgrid[-_REACH : _REACH + 1, -_REACH : _REACH + 1]).ravel().astype(np.float32)


def refine_borders(
    labels: NDArray[np.int32],
    inverse_depth: NDArray[np.float32],
    surfaces: SurfaceTable,
    config: SegmentationConfig,
    *,
    rms_per_m: Sequence[float],
    step: int = 1,
    sweeps: int = _SWEEPS,
    spread_severed: bool = True,
) -> NDArray[np.int32]:
    """Move borders to where the surfaces on both sides, extrapolated beyond them, explain the points best.

    The cost of a label at a pixel is minus twice the logarithm of a normal likelihood, with a limited squared
    residual of inverse depth, less the votes of the neighbors, which weigh one over their distance, and less
    across a gap in depth. In a few sweeps, pixels with neighbors of another label take the cheapest of
    their labels (iterated conditional modes [1]_).

    Parameters
    ----------
    labels : (H, W) int32
        1 to the number of surfaces; 0 where there is no point.
    inverse_depth : (H, W) float32
        Inverse depth, 1/m.
    surfaces : SurfaceTable
        Those of the labels; a label without one explains nothing.
    config : SegmentationConfig
        Noise, gap and smallest component.
    rms_per_m : sequence of float
        Root mean square residual of each surface, 1/m: its deviation, if larger than the noise.
    step : int
        Pixels of the image from one row or column of the labels to the next.
    sweeps : int
        Largest number of sweeps.
    spread_severed : bool
        Whether small components that a border cuts off go to their neighbors.

    Returns
    -------
    (H, W) int32
        The new labels. A label that would lose its last pixel keeps all.

    References
    ----------
    .. [1] J. Besag, "On the statistical analysis of dirty pictures", Journal of the Royal Statistical
       Society B 48(3), 1986.
    """
    count = surfaces.splines.starts.size - 1
    if count < 2:
        return labels
    deviations = surface_deviations(rms_per_m, config.extended.inverse_depth_noise)
    gap_per_m = config.extended.inverse_depth_gap
    # A margin as wide as the reach, so that all pixels have all neighbors.
    margin = (_REACH, _REACH, _REACH, _REACH, cv2.BORDER_CONSTANT)
    padded = np.asarray(cv2.copyMakeBorder(labels, *margin), dtype=np.int32)
    depths = np.asarray(cv2.copyMakeBorder(inverse_depth, *margin), dtype=np.float32).ravel()
    flat, width = padded.reshape(-1), padded.shape[1]
    gaps = (gap_per_m * np.sqrt(_DISTANCES)).astype(np.float32)
    votes = np.where(_DISTANCES > 0, _VOTE / np.maximum(_DISTANCES, 1.0), 0.0).astype(np.float32)

    reached, margins = np.empty(flat.size, dtype=np.bool_), np.zeros(flat.size, dtype=np.float32)
    pixels = np.flatnonzero(_near_borders(padded))
    for sweep in range(sweeps):
        if pixels.size == 0:
            break
        neighbors, splines = (gaps, votes), surfaces.splines
        best = _cheapest(flat, depths, pixels, width, step, neighbors, splines, deviations, margins)
        # Only pixels within reach of a change can change now. From the third sweep on only neighbors
        # that swap labels are left: one of two at a time.
        reached[:] = False
        _move(flat, width, pixels, best, sweep + 1 if sweep > 0 else -1, votes, margins, reached)
        pixels = np.flatnonzero(reached)
    refined = np.ascontiguousarray(padded[_REACH:-_REACH, _REACH:-_REACH])

    if spread_severed:
        adjacency = pixel_adjacency(inverse_depth, refined > 0, gap_per_m)
        least = config.extended.piece_pixels_min * (labels.size / REFERENCE_PIXELS)
        severed = connected_components(refined, adjacency, least, keep=count).small
        spread_labels(refined, severed, inverse_depth, gap_per_m)
    lost = label_sizes(refined, count + 1) == 0
    if lost[1:].any():
        kept = lost[labels]
        refined[kept] = labels[kept]
    return refined


class Deviations(NamedTuple):
    """Deviations of residuals by label; 0 is none.

    Parameters
    ----------
    precision_m : (labels + 1,) float32
        One over the deviation of inverse depth, meters.
    penalty : (labels + 1,) float32
        Twice the logarithm of the deviation over that of the noise.
    """

    precision_m: NDArray[np.float32]
    penalty: NDArray[np.float32]


def surface_deviations(rms_per_m: ArrayLike, noise_per_m: float) -> Deviations:
    """Return the deviations of surfaces: their root mean square residuals, at least the noise."""
    deviation = np.maximum(np.concatenate([[noise_per_m], np.asarray(rms_per_m)]), noise_per_m)
    return Deviations(
        (1.0 / deviation).astype(np.float32), (2.0 * np.log(deviation / noise_per_m)).astype(np.float32)
    )


@compiled
def _cheapest(
    labels: I32,
    inverse_depth: F32,
    pixels: Intp,
    width: int,
    step: int,
    neighbors: tuple[F32, F32],
    splines: Splines,
    deviations: Deviations,
    margins: F32,
) -> I32:
    """Find the cheapest of the labels around each pixel, the smallest one among several.

    Neighbors are given by the gaps to them and by their votes. The margin of a pixel becomes by how much any
    other label costs more, at least.
    """
    best = np.empty(pixels.size, dtype=np.int32)
    # Taken out of tuples once: in the loop, their references would be counted each time.
    gaps_per_m, votes = neighbors
    axes, weights, starts = splines
    precision_m, penalty = deviations
    near, steps_per_m = np.empty(_AROUND, dtype=np.int32), np.empty(_AROUND, dtype=np.float32)
    near_votes = np.empty(_AROUND, dtype=np.float32)
    one, across_gap = np.float32(1.0), np.float32(ACROSS_GAP)
    row = 0
    for n in range(pixels.size):
        pixel, own = pixels[n], labels[pixels[n]]
        # Pixels ascend; a division is slower.
        while pixel >= (row + 1) * width:
            row += 1
        at_row, at_column = (row - _REACH) * step, (pixel - row * width - _REACH) * step
        for down in range(_SIDE):
            start = np.uint32(pixel + (down - _REACH) * width - _REACH)
            for across in range(_SIDE):
                near[down * _SIDE + across] = labels[start + across]
                steps_per_m[down * _SIDE + across] = inverse_depth[start + across] - inverse_depth[pixel]
        for k in range(_AROUND):
            # A factor, as a choice between two arrays would be one of addresses.
            near_votes[k] = votes[k] * (across_gap if abs(steps_per_m[k]) >= gaps_per_m[k] else one)
        # A label that is not around costs no less than 0.
        best[n], least, others = own, np.float32(np.inf), np.float32(0.0)
        # A pixel's own label comes first, then the others from the largest on.
        label, below = own, np.int32(2**31 - 1)
        while label > 0:
            total, following = np.float32(0.0), np.int32(0)
            for k in range(_AROUND):
                total += near_votes[k] if near[k] == label else np.float32(0.0)
                following = max(following, near[k] if near[k] < below and near[k] != own else np.int32(0))
            if label == own and following == 0:
                break
            # Without a residual; where that is too much already, the surface is not looked up.
            cost = penalty[label] - total
            if cost <= least:
                square = np.float32(SQUARE_MOST)
                if axes[label, 0, 2] > 0.0:
                    explained = spline_at(axes, weights, starts, label, at_row, at_column)
                    residual = (np.float32(explained) - inverse_depth[pixel]) * precision_m[label]
                    # False for NaN and inf.
                    if residual * residual < square:
                        square = residual * residual
                cost += square
                if cost < least or (cost == least and label < best[n]):
                    cost, least, best[n] = least, cost, label
            others = min(others, cost)
            label = below = following
        margins[pixel] = others - least
    return best


@compiled
def _move(
    labels: I32,
    width: int,
    pixels: Intp,
    best: I32,
    parity: int,
    votes: F32,
    margins: F32,
    reached: Bool,
) -> None:
    """Give pixels new labels, and mark the labeled pixels within reach of those that changed.

    Of these only the ones that can change now, and whose row and column add up to an even number with
    `parity`, unless that is less than 0.
    """
    for n in range(pixels.size):
        if best[n] == labels[pixels[n]]:
            continue
        labels[pixels[n]] = best[n]
        row, column = pixels[n] // width, pixels[n] % width
        for k in range(_AROUND):
            r, c = row + k // _SIDE - _REACH, column + k % _SIDE - _REACH
            at = np.uint32(r * width + c)
            # What votes for another label no longer votes for the pixel's own.
            margins[at] -= np.float32(2.0) * votes[k]
            wanted = parity < 0 or (r + c + parity) % 2 == 0
            reached[at] = wanted and labels[at] > 0 and margins[at] <= _ROUNDING


def _near_borders(labels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Find labeled pixels with another label within reach."""
    kernel = np.ones((2 * _REACH + 1, 2 * _REACH + 1), dtype=np.uint8)
    # Narrow integers are faster.
    image: NDArray[np.integer] = labels.astype(np.uint8 if labels.max() < 255 else np.uint16)
    largest = cv2.dilate(image, kernel)
    # Less 1, no label becomes the largest number.
    least = cv2.erode(image - image.dtype.type(1), kernel) + image.dtype.type(1)
    return np.asarray((image > 0) & (largest != least))
