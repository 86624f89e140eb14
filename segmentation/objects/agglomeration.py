"""Greedy merging of surfaces, with evidence computed again for what has been merged."""

from typing import NamedTuple

import numpy as np

from nurbseg.common.compiled import F64, I64, Bool, compiled, inlined
from nurbseg.segmentation.objects import border_statistics
from nurbseg.segmentation.objects.border_statistics import SAMPLES, add_border
from nurbseg.segmentation.objects.pair_features import (
    FEATURES,
    TERMS,
    MergingModel,
    Scene,
    add_terms,
    pair_features,
)
from nurbseg.segmentation.objects.surface_statistics import COUNT, along, plane
from nurbseg.segmentation.points.grid import DepthGrid

#: Weight of evidence computed again for merged surfaces, against the average over their parts' borders.
RENEWED = 0.75
#: Decimals to which evidence is rounded, as exported.
DIGITS = 3

_TERMS = len(TERMS)
_BORDER_SUMS = border_statistics.SUMS
_DIGIT = 10.0**DIGITS


class Pairs(NamedTuple):
    """P pairs of surfaces whose borders meet.

    Parameters
    ----------
    labels : (P, 2) int64
        The smaller one first.
    sums : (P, 19) float64
        Along the borders, see `BorderStatistics`.
    log_odds : (P,) float64
        Sum of the evidence.
    kept : (P,) float64
        What is added for the state in the frame before.
    """

    labels: I64
    sums: F64
    log_odds: F64
    kept: F64


@inlined
def _rounded(value: float) -> float:
    return float(np.rint(value * _DIGIT) / _DIGIT)


def scene_of(surfaces: F64, grid: DepthGrid, noise_per_m: float) -> Scene:
    """Return what the features of all pairs of a frame share.

    Parameters
    ----------
    surfaces : (L, 19) float64
        As `surface_statistics` returns them.
    grid : DepthGrid
        The points.
    noise_per_m : float
        Standard deviation of inverse depth, 1/m.
    """
    height, width = grid.shape
    focal_u, focal_v = (focal_px / (width * grid.step) for focal_px in grid.rays.focal_px)
    center = (np.full(1, (size - 1) / 2 * grid.step) for size in (width, height))
    (x,), (y,) = grid.rays.at(*center)
    camera = focal_u, focal_v, float(x), float(y)
    up_x, up_y, up_z, level_m = _support_plane(surfaces, camera)
    up = up_x, up_y, up_z
    return Scene(camera, grid.unit_px, grid.step / grid.unit_px, noise_per_m, up, level_m)


@compiled
def _support_plane(
    surfaces: F64, camera: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Return the normal of the support's plane, and the mean of its points along it, meters."""
    own = surfaces[np.argmax(surfaces[:, COUNT])]
    x, y, z, _ = plane(own, camera)
    return x, y, z, along(own, (x, y, z))[0]


@compiled
def _evidence(
    border: F64, one: int, other: int, surfaces: F64, lengths: F64, scene: Scene, model: MergingModel
) -> F64:
    features, terms = np.empty(FEATURES), np.zeros(_TERMS)
    pair_features(features, border, (surfaces[one], surfaces[other]), (lengths[one], lengths[other]), scene)
    add_terms(terms, features, model)
    for k in range(_TERMS):
        terms[k] = _rounded(terms[k])
    return terms


@inlined
def _lengths(labels: I64, sums: F64, count: int) -> F64:
    lengths = np.zeros(count)
    for n in range(labels.shape[0]):
        lengths[labels[n, 0]] += sums[n, SAMPLES]
        lengths[labels[n, 1]] += sums[n, SAMPLES]
    return lengths


@compiled
def evidence(labels: I64, sums: F64, surfaces: F64, scene: Scene, model: MergingModel) -> F64:
    """Weigh the evidence for and against each pair of surfaces being one object.

    Parameters
    ----------
    labels, sums
        As those of `BorderStatistics`.
    surfaces : (L, 19) float64
        As `surface_statistics` returns them.
    scene : Scene
        Of the frame.
    model : MergingModel
        What features weigh.

    Returns
    -------
    (P, len(TERMS)) float64
        Terms of the log odds, in the order of `TERMS`, to `DIGITS` digits.
    """
    lengths = _lengths(labels, sums, surfaces.shape[0])
    terms = np.empty((labels.shape[0], _TERMS))
    for n in range(labels.shape[0]):
        terms[n] = _evidence(sums[n], labels[n, 0], labels[n, 1], surfaces, lengths, scene, model)
    return terms


@compiled
def agglomerate(
    pairs: Pairs, surfaces: F64, scene: Scene, model: MergingModel, least: float
) -> tuple[I64, I64, Bool, F64, F64]:
    """Merge the likeliest two groups of surfaces again and again, as long as they are likely enough.

    The log odds of two groups are those of the evidence computed again as if each were one surface, weighted
    by `RENEWED`, and the average over the borders of their surfaces, weighted by samples [1]_. Of equally
    likely ones, those with the smallest labels are first.

    Parameters
    ----------
    pairs : Pairs
        Those that meet.
    surfaces : (L, 19) float64
        As `surface_statistics` returns them; label 0 is none.
    scene : Scene
        Of the frame.
    model : MergingModel
        What features weigh.
    least : float
        Groups are merged if their log odds are more.

    Returns
    -------
    group : (L,) int64
        The smallest label of each label's group.
    decided : (D, 2) int64
        Groups that were merged, in order, and then those that meet and were not, by their smallest labels.
    merged : (D,) bool
        Which of the two.
    log_odds : (D,) float64
        Of the two.
    terms : (D, len(TERMS) + 1) float64
        Evidence computed again, and what memory adds; 0 of two surfaces that were not merged before.

    References
    ----------
    .. [1] A. Bailoni et al., "GASP, a generalized framework for agglomerative clustering of signed graphs",
       CVPR 2022.
    """
    count, size = len(pairs.labels), surfaces.shape[0]
    surfaces, group = surfaces.copy(), np.arange(size)
    lengths = _lengths(pairs.labels, pairs.sums, size)
    # Rows of pairs of groups, and where they are; a row that was added to another is -1, -1.
    ends, sums, weight = pairs.labels.copy(), pairs.sums.copy(), pairs.sums[:, SAMPLES].copy()
    total, memory = pairs.log_odds * weight, pairs.kept * weight
    log_odds = np.array([_rounded(each) for each in pairs.log_odds + pairs.kept])
    terms, row_of = np.zeros((count, _TERMS + 1)), np.full((size, size), -1)
    for n in range(count):
        row_of[ends[n, 0], ends[n, 1]] = row_of[ends[n, 1], ends[n, 0]] = n
    decided, merged = np.empty((count, 2), dtype=np.int64), np.zeros(count, dtype=np.bool_)
    out_odds, out_terms, made = np.empty(count), np.zeros((count, _TERMS + 1)), 0
    while True:
        best = -1
        for n in range(count):
            if ends[n, 0] < 0 or not log_odds[n] > least:
                continue
            # Rows are not in the order of their labels any more once groups were merged.
            own = (-log_odds[n], ends[n, 0], ends[n, 1])
            if best < 0 or own < (-log_odds[best], ends[best, 0], ends[best, 1]):
                best = n
        if best < 0:
            break
        one, gone = ends[best]
        decided[made, 0], decided[made, 1], merged[made] = one, gone, True
        out_odds[made], out_terms[made] = log_odds[best], terms[best]
        made += 1
        ends[best] = -1
        row_of[one, gone] = row_of[gone, one] = -1
        group[group == gone] = one
        lengths[one] += lengths[gone] - 2.0 * sums[best, SAMPLES]
        surfaces[one] += surfaces[gone]
        for other in range(1, size):
            row = row_of[gone, other]
            if row >= 0:
                _move_border(row, gone, one, other, ends, sums, weight, total, memory, row_of)
            row = row_of[one, other]
            if row < 0:
                continue
            terms[row, :_TERMS] = _evidence(
                sums[row], ends[row, 0], ends[row, 1], surfaces, lengths, scene, model
            )
            terms[row, _TERMS] = _rounded(memory[row] / weight[row])
            mean = total[row] / weight[row]
            renewed = RENEWED * terms[row, :_TERMS].sum() + (1.0 - RENEWED) * mean
            log_odds[row] = _rounded(renewed + terms[row, _TERMS])
    for one in range(1, size):
        for other in range(one + 1, size):
            row = row_of[one, other]
            if row >= 0:
                decided[made, 0], decided[made, 1] = one, other
                out_odds[made], out_terms[made] = log_odds[row], terms[row]
                made += 1
    return group, decided[:made], merged[:made], out_odds[:made], out_terms[:made]


@compiled
def _move_border(
    row: int,
    gone: int,
    one: int,
    other: int,
    ends: I64,
    sums: F64,
    weight: F64,
    total: F64,
    memory: F64,
    row_of: I64,
) -> None:
    """Give a border of a group that is gone, with another one, to the group that it was merged into."""
    turned, into = (gone < other) != (one < other), row_of[one, other]
    row_of[gone, other] = row_of[other, gone] = -1
    if into < 0:
        own = np.zeros(_BORDER_SUMS)
        add_border(own, sums[row], turned)
        sums[row] = own
        ends[row, 0], ends[row, 1] = min(one, other), max(one, other)
        row_of[one, other] = row_of[other, one] = row
        return
    add_border(sums[into], sums[row], turned)
    weight[into] += weight[row]
    total[into] += total[row]
    memory[into] += memory[row]
    ends[row] = -1
