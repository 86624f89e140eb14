"""Evidence for and against two surfaces being one object: features of a pair, and their weights."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.objects.border_statistics import BorderStatistics
from nurbseg.segmentation.objects.surface_statistics import SurfaceStatistics


class Term(NamedTuple):
    """A feature of a pair of surfaces: its weight in the log odds, and its neutral value."""

    name: str
    weight: float
    neutral: float


#: Log odds of two surfaces being one object are `BASE` plus, for each feature, its weight times its
#: difference from the neutral value. ``python benchmarks/merging.py`` trains them: docs/default-method.md.
BASE = 1.08
TERMS = (
    # Mean concavity where they touch, 0 for a convex crease, about radians; 1 at most.
    Term("concave", -4.91, 0.28),
    # Its standard deviation along the border, 0.6 at most: a crease that noise alone makes has a large one.
    Term("uneven", -4.63, 0.31),
    # Mean distance of the surfaces at their border, in gaps, 4 at most.
    Term("apart", -3.99, 0.48),
    # Share of the smaller one's border that is shared with the larger one.
    Term("enclosed", 5.65, 0.32),
    # Logarithm of the size of the larger one, in pixels of an image of 640 columns.
    Term("larger", -0.73, 8.62),
    # Distance of the smaller one's center in front of the larger one's plane, in noise deviations: arsinh.
    Term("front", -0.54, -0.41),
)
#: Log odds where two surfaces do not touch.
GAP = -1.5
#: Terms of the log odds, in the order of `evidence`; the last is the hysteresis of the live tree.
ITEMS = ("base", *(term.name for term in TERMS), "gap", "kept")
#: Decimals to which evidence is rounded, as exported.
DIGITS = 3

#: Limits of concavity and its deviation, radians.
_CONCAVITY_MOST, _DEVIATION_MOST = 1.0, 0.6


def pair_features(
    borders: BorderStatistics, surfaces: SurfaceStatistics, noise_per_m: float
) -> NDArray[np.float64]:
    """Compute the features of every pair of surfaces whose borders meet.

    Parameters
    ----------
    borders : BorderStatistics
        Of P pairs.
    surfaces : SurfaceStatistics
        By label.
    noise_per_m : float
        Standard deviation of inverse depth, 1/m.

    Returns
    -------
    (P, 6) float64
        In the order of `TERMS`.
    """
    pair = borders.labels
    lengths = np.bincount(pair.ravel(), np.repeat(borders.samples, 2), minlength=surfaces.pixels.size)
    first_is_larger = surfaces.pixels[pair[:, 0]] > surfaces.pixels[pair[:, 1]]
    small, large = np.where(first_is_larger, pair.T[::-1], pair.T)

    touching = np.maximum(borders.touching, 1.0)
    concavity = borders.concavity / touching
    deviation = np.sqrt(np.maximum(borders.concavity_square / touching - concavity**2, 0.0))
    before_m = ((surfaces.center_m[small] - surfaces.center_m[large]) * surfaces.normal[large]).sum(axis=1)
    noise_m = noise_per_m * np.maximum(surfaces.center_m[small, 2], 1e-3) ** 2
    return np.stack(
        [
            np.clip(concavity, 0.0, _CONCAVITY_MOST),
            np.minimum(deviation, _DEVIATION_MOST),
            borders.apart / np.maximum(borders.samples, 1.0),
            borders.samples / np.maximum(lengths[small], 1.0),
            np.log(np.maximum(surfaces.pixels[large], 1.0)),
            np.arcsinh(before_m / noise_m),
        ],
        axis=1,
    )


def evidence(
    borders: BorderStatistics, surfaces: SurfaceStatistics, noise_per_m: float
) -> NDArray[np.float64]:
    """Weigh the evidence for and against each pair of surfaces being one object.

    Parameters
    ----------
    borders, surfaces, noise_per_m
        As for `pair_features`.

    Returns
    -------
    (P, 9) float64
        Of each pair, by `ITEMS`, the last 0; its log odds are their sum. If surfaces do not touch, only the
        gap counts.
    """
    weights, neutral = (np.array([each[n] for each in TERMS]) for n in (1, 2))
    items = np.zeros((len(borders.labels), len(ITEMS)))
    touch = borders.in_contact
    items[touch, 0] = BASE
    items[touch, 1:-2] = (weights * (pair_features(borders, surfaces, noise_per_m) - neutral))[touch]
    items[~touch, -2] = GAP
    return np.round(items, DIGITS)
