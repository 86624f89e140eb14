"""Things: objects that others separate in the image, joined if one surface explains both."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.cut.features import lab
from nurbseg.segmentation.labels.images import inner_pixels
from nurbseg.segmentation.objects.merge import Contact, SceneObject, largest_first
from nurbseg.segmentation.points.grid import DepthGrid

#: An object is compared by its largest surface, if that is at least this share of it.
_SHARE_MIN = 0.5
#: Grid pixels of a surface that are compared, at most, and at least.
_SAMPLES, _SAMPLES_MIN = 400, 15
#: Largest root mean square residual on the joint surface, relative to that on a surface of its own, and on
#: the continuation of the other surface, in standard deviations of the noise.
_RATIO_MOST, _CONTINUED_MOST = 1.4, 5.0
#: A surface's own residuals count as at least this, in standard deviations of the noise.
_OWN_LEAST = 0.5
#: Largest difference of the median colors, CIELab.
_COLOR_MOST = 30.0
#: Lines sampled between two surfaces, and samples on each. Least share of the samples in between that are
#: nearer than the joint surface, and largest share that are farther.
_LINES, _LINE_SAMPLES = 60, 40
_NEARER_LEAST, _FARTHER_MOST = 0.5, 0.1
#: Nearer or farther means by this many standard deviations of the noise.
_MARGIN = 4.0
#: Factor by which the limits are eased for surfaces that were joined in the previous frame.
_EASED = 1.5
#: Number of terms of a plane and of a quadric of inverse depth.
_TERMS = (3, 6)


@dataclass(frozen=True, slots=True)
class Join:
    """Two surfaces of objects that do not meet in the image, and the evidence that they are one thing.

    Parameters
    ----------
    first, second : str
        Names of the leaves.
    ratio : float
        Root mean square residual on the surface fitted to both, over that on a surface fitted to one
        alone: the larger one.
    continued : float
        Root mean square residual on the continuation of the other, in standard deviations of the noise: the
        smaller one.
    color : float
        Difference of their median colors, CIELab.
    nearer : float
        Share of the pixels between them that are nearer than the surface fitted to both.
    """

    first: str
    second: str
    ratio: float
    continued: float
    color: float
    nearer: float


@dataclass(frozen=True, slots=True, eq=False)
class _Sampled:
    """Sampled points of the largest surface of an object.

    `terms`, (N, 6), are those of a quadric in u and v, measured from the center of the image in image widths.
    `alone` holds the plane and the quadric fitted to them, each with its root mean square residual, 1/m.
    """

    number: int
    name: str
    terms: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    color_lab: NDArray[np.float64]
    alone: list[tuple[NDArray[np.float64], float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        for count in _TERMS:
            surface = _fitted([self], count)
            self.alone.append((surface, self.rms_per_m(surface)))

    def rms_per_m(self, surface: NDArray[np.float64]) -> float:
        """Return the root mean square residual on a surface, 1/m."""
        residuals = self.terms[:, : surface.size] @ surface - self.inverse_depth
        return float(np.sqrt(np.dot(residuals, residuals) / residuals.size))


def join_objects(
    objects: Sequence[SceneObject],
    contacts: Sequence[Contact],
    labels: NDArray[np.int32],
    names: Sequence[str],
    grid: DepthGrid,
    color: NDArray[np.uint8],
    config: SegmentationConfig,
    *,
    kept: Collection[frozenset[str]] = (),
) -> tuple[tuple[SceneObject, ...], tuple[Join, ...]]:
    """Join objects that others separate in the image.

    Two objects that do not meet are joined if a plane or a quadric of inverse depth fitted to the largest
    surfaces of both explains each as well as one fitted to it alone, if one continues the other, if
    their colors agree, and if what lies between them in the image is nearer than that surface.

    Parameters
    ----------
    objects, contacts
        As `merge_surfaces` returns them.
    labels : (h, w) int32
        Of the grid pixels: the index of the leaf plus one; 0 where there is no point.
    names : sequence of str
        Of the leaf of each label.
    grid : DepthGrid
        The points.
    color : (H, W, 3) uint8
        RGB of the image.
    config : SegmentationConfig
        Level and noise; nothing is joined unless the level is things.
    kept : collection of frozenset of str
        Pairs of leaves that were joined in the previous frame, for which the limits are eased.

    Returns
    -------
    objects : tuple of SceneObject
        The one with most grid pixels first.
    joins : tuple of Join
        One for each pair of groups that was joined, in order; the smallest ratio first.
    """
    if config.extended.level != "things":
        return tuple(objects), ()
    label_of = {name: label for label, name in enumerate(names, start=1)}
    members = [[label_of[name] for name in each.leaves] for each in objects]
    object_of = np.full(len(names) + 1, -1)
    for number, member in enumerate(members):
        object_of[member] = number
    object_image = object_of[labels]
    counts = np.bincount(labels.ravel(), minlength=len(names) + 1)
    meet = {
        frozenset(object_of[[label_of[contact.first], label_of[contact.second]]].tolist())
        for contact in contacts
    }

    found = []
    for one, other in combinations(_sampled(members, counts, labels, names, grid, color), 2):
        eased = _EASED if frozenset((one.name, other.name)) in kept else 1.0
        join = _join(one, other, object_image, grid, config, eased)
        if join is not None:
            found.append((join, one.number, other.number))

    group = {number: {number} for number in range(len(objects))}
    joins = []
    for join, *pair in sorted(found, key=lambda each: (each[0].ratio, *each[1:])):
        first, second = (group[number] for number in pair)
        # Objects that meet were judged by their border.
        if first is second or any(frozenset(each) in meet for each in product(first, second)):
            continue
        joins.append(join)
        both = first | second
        group.update(dict.fromkeys(both, both))
    things = {min(each): each for each in group.values()}
    leaves = (sorted(label for number in thing for label in members[number]) for thing in things.values())
    return largest_first(leaves, counts, names), tuple(joins)


def _sampled(
    members: Sequence[Sequence[int]],
    counts: NDArray[np.intp],
    labels: NDArray[np.int32],
    names: Sequence[str],
    grid: DepthGrid,
    color: NDArray[np.uint8],
) -> list[_Sampled]:
    """Sample the largest surface of each object, if it is large enough."""
    # Pixels at a border may be mixed with what lies behind.
    inner = np.where(inner_pixels(labels), labels, 0)
    height, width = labels.shape
    found = []
    for number, member in enumerate(members):
        label = max(member, key=lambda label: counts[label])
        pixels = np.flatnonzero(inner == label)
        if counts[label] < _SHARE_MIN * counts[member].sum() or pixels.size < _SAMPLES_MIN:
            continue
        v, u = np.divmod(pixels[:: -(-pixels.size // _SAMPLES)], width)
        terms = _terms((u - 0.5 * width) / width, (v - 0.5 * height) / width)
        inverse_depth = grid.inverse_depth[v, u].astype(np.float64)
        color_lab = np.median(lab(color[v * grid.step, u * grid.step]), axis=0).astype(np.float64)
        found.append(_Sampled(number, names[label - 1], terms, inverse_depth, color_lab))
    return found


def _terms(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the terms of a quadric, (..., 6); the first three are those of a plane."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _join(
    one: _Sampled,
    other: _Sampled,
    object_image: NDArray[np.intp],
    grid: DepthGrid,
    config: SegmentationConfig,
    eased: float,
) -> Join | None:
    """Return the evidence that two surfaces are one thing, or None if they are not."""
    color = float(np.linalg.norm(one.color_lab - other.color_lab))
    if color > _COLOR_MOST * eased:
        return None
    noise_per_m = config.extended.inverse_depth_noise
    for count, (first, first_rms), (second, second_rms) in zip(_TERMS, one.alone, other.alone, strict=True):
        continued = min(one.rms_per_m(second), other.rms_per_m(first)) / noise_per_m
        if continued > _CONTINUED_MOST * eased:
            continue
        both, least = _fitted((one, other), count), _OWN_LEAST * noise_per_m
        ratio = max(
            one.rms_per_m(both) / max(first_rms, least), other.rms_per_m(both) / max(second_rms, least)
        )
        if ratio > 1.0 + (_RATIO_MOST - 1.0) * eased:
            continue
        nearer, farther = _between(one, other, object_image, grid, config, both)
        if nearer >= _NEARER_LEAST / eased and farther <= _FARTHER_MOST * eased:
            return Join(one.name, other.name, *(round(each, 3) for each in (ratio, continued, color, nearer)))
    return None


def _fitted(points: Sequence[_Sampled], count: int) -> NDArray[np.float64]:
    """Fit a surface with `count` terms by least squares; each set of points has the same weight."""
    weights = [1.0 / np.sqrt(point.inverse_depth.size) for point in points]
    terms = [weight * point.terms[:, :count] for weight, point in zip(weights, points, strict=True)]
    depths = [weight * point.inverse_depth for weight, point in zip(weights, points, strict=True)]
    return np.asarray(np.linalg.lstsq(np.concatenate(terms), np.concatenate(depths), rcond=None)[0])


def _between(
    one: _Sampled,
    other: _Sampled,
    object_image: NDArray[np.intp],
    grid: DepthGrid,
    config: SegmentationConfig,
    surface: NDArray[np.float64],
) -> tuple[float, float]:
    """Return the shares of samples between two objects that are nearer and farther than a surface."""
    rng = np.random.default_rng(config.seed)
    start, end = (
        each.terms[rng.integers(each.terms.shape[0], size=_LINES), 1:3].T[..., np.newaxis]
        for each in (one, other)
    )
    u, v = start + (end - start) * np.linspace(0.0, 1.0, _LINE_SAMPLES)
    height, width = object_image.shape
    at = tuple(np.rint(each * width + 0.5 * size).astype(np.intp) for each, size in ((v, height), (u, width)))
    between = ~np.isin(object_image[at], (one.number, other.number))
    found, expected = grid.inverse_depth[at].astype(np.float64), _terms(u, v)[..., : surface.size] @ surface
    margin, total = _MARGIN * config.extended.inverse_depth_noise, max(1, int(np.count_nonzero(between)))
    nearer, farther = (
        int(np.count_nonzero(between & (found > 0) & each)) / total
        for each in (found > expected + margin, found < expected - margin)
    )
    return nearer, farther
