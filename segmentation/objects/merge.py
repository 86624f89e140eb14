"""Objects: surfaces merged by the evidence along their borders."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.config import SegmentationConfig
from nurbseg.segmentation.labels.images import label_sizes
from nurbseg.segmentation.lazy import Lazy
from nurbseg.segmentation.objects.agglomeration import DIGITS, Pairs, agglomerate, evidence, scene_of
from nurbseg.segmentation.objects.border_statistics import (
    SAMPLES,
    TOUCHING,
    BorderStatistics,
    border_statistics,
)
from nurbseg.segmentation.objects.pair_features import TERMS, Scene, merging_model
from nurbseg.segmentation.objects.surface_statistics import surface_statistics
from nurbseg.segmentation.points.grid import DepthGrid
from nurbseg.segmentation.surfaces.surface_table import SurfaceTable

#: Terms of the log odds as they are exported; the last is the hysteresis of the live tree.
ITEMS = (*TERMS, "kept")


@dataclass(frozen=True, slots=True)
class SceneObject:
    """Surfaces that were merged.

    Parameters
    ----------
    leaves : tuple of str
        Names of its leaves, in the order of the tree.
    """

    leaves: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Contact:
    """Two leaves whose borders meet, and whether they were merged.

    Parameters
    ----------
    first, second : str
        Names of the leaves.
    merged : bool
        Whether they are in the same object.
    samples, touching : int
        Grid pixels along the border, and those where the surfaces agree.
    log_odds : float
        That the two are one object, from this pair alone.
    evidence : mapping of str to float
        Terms of the log odds, by name, but for those that are 0.
    log_odds_min : float
        What two leaves must exceed to be merged by their pair alone.
    """

    first: str
    second: str
    merged: bool
    samples: int
    touching: int
    log_odds: float
    evidence: Mapping[str, float]
    log_odds_min: float = 0.0

    @property
    def reason(self) -> str:
        """Why they are one object or not: the log odds with the strongest terms for and against."""
        by_weight = sorted((item, name) for name, item in self.evidence.items() if name != "base")
        most = by_weight[-1:] + by_weight[:-1][:1]
        terms = " and ".join(f"{name} {item:+.1f}" for item, name in most)
        why = f"log odds of {self.log_odds:+.2f}" + (f", of which {terms}" if terms else "")
        if self.merged and self.log_odds <= self.log_odds_min:
            return f"merged through other surfaces, despite {why}"
        if self.log_odds > self.log_odds_min and not self.merged:
            return f"{why}, but those of the objects they belong to are too low"
        return why


@dataclass(frozen=True, slots=True)
class Merge:
    """Two groups of leaves that were merged, or that meet and were not.

    Parameters
    ----------
    first, second : str
        Names of the first leaf of each group, as it was then.
    merged : bool
        Whether they were merged.
    log_odds : float
        That the two are one object: of two leaves, those of their contact; else `RENEWED` times the sum of
        the evidence, for the rest the average over the contacts between them, weighted by samples, both
        without ``kept``, and then ``kept``.
    evidence : mapping of str to float
        Terms of the log odds as computed again for the groups, by name, but for those that are 0; none for
        two leaves. ``kept`` is what the frames before add in a live run.
    """

    first: str
    second: str
    merged: bool
    log_odds: float
    evidence: Mapping[str, float]


class Objects(NamedTuple):
    """Objects of a frame, largest first, and how they came about; all empty if merging is off.

    Parameters
    ----------
    objects : tuple of SceneObject
        Merged leaves.
    contacts : sequence of Contact
        All leaves whose borders meet.
    merges : sequence of Merge
        In order; then the groups that meet and were not merged, if one has several leaves.
    """

    objects: tuple[SceneObject, ...] = ()
    contacts: Sequence[Contact] = ()
    merges: Sequence[Merge] = ()


class Measured(NamedTuple):
    """What merging knows of a frame: its borders, sums over its surfaces, and the evidence of each pair."""

    borders: BorderStatistics
    surfaces: NDArray[np.float64]
    scene: Scene
    items: NDArray[np.float64]


def measure(
    labels: NDArray[np.int32],
    grid: DepthGrid,
    count: int,
    surfaces: SurfaceTable,
    config: SegmentationConfig,
) -> Measured:
    """Measure borders and surfaces, and weigh the evidence of each pair.

    Parameters
    ----------
    labels, grid, surfaces, config
        As for `merge_surfaces`.
    count : int
        Number of labels.

    Returns
    -------
    Measured
        Its `items`, (P, len(ITEMS)), are the terms of each pair; the last, ``kept``, is 0.
    """
    extended = config.extended
    borders = border_statistics(labels, surfaces.slopes, grid.rays, gap_per_m=extended.inverse_depth_gap)
    sums = surface_statistics(labels[:: grid.step, :: grid.step], count, grid)
    scene = scene_of(sums, grid, extended.inverse_depth_noise)
    items = np.zeros((len(borders.labels), len(ITEMS)))
    items[:, :-1] = evidence(borders.labels, borders.sums, sums, scene, merging_model())
    return Measured(borders, sums, scene, items)


def merge_surfaces(
    labels: NDArray[np.int32],
    grid: DepthGrid,
    names: Sequence[str],
    surfaces: SurfaceTable,
    config: SegmentationConfig,
) -> Objects:
    """Merge adjacent surfaces into objects.

    Each pair that meets has log odds of being one object (see `evidence`). The likeliest pair is merged, its
    evidence with others computed again (see `agglomerate`), until no pair is likely enough.

    Parameters
    ----------
    labels : (H, W) int32
        1 to the number of surfaces; 0 where there is no point.
    grid : DepthGrid
        The points.
    names : sequence of str
        Of the leaf of each label.
    surfaces : SurfaceTable
        Those of the labels.
    config : SegmentationConfig
        Whether to merge, the least log odds, noise and gap.

    Returns
    -------
    Objects
        None if merging is off.
    """
    if not config.extended.merge_surfaces:
        return Objects()
    return merged_objects(measure(labels, grid, len(names), surfaces, config), labels, names, config)


def merged_objects(
    measured: Measured,
    labels: NDArray[np.int32],
    names: Sequence[str],
    config: SegmentationConfig,
) -> Objects:
    """Merge surfaces by the evidence along their borders.

    Parameters
    ----------
    measured : Measured
        Borders, surfaces and evidence.
    labels : (H, W) int32
        1 to the number of surfaces; on all pixels, or evenly on some of them.
    names : sequence of str
        Of the leaf of each label.
    config : SegmentationConfig
        The least log odds.

    Returns
    -------
    Objects
        None if there is no label.
    """
    borders, surfaces, scene, items = measured
    pairs = Pairs(borders.labels, borders.sums, items[:, :-1].sum(axis=1), items[:, -1].copy())
    least, model = config.extended.log_odds_min, merging_model()
    group, decided, merged, odds, terms = agglomerate(pairs, surfaces, scene, model, least)
    members: dict[int, list[int]] = {}
    for label, number in enumerate(group[1:].tolist(), start=1):
        members.setdefault(number, []).append(label)
    return Objects(
        largest_first(members.values(), label_sizes(labels, len(names) + 1), names),
        Lazy(partial(_contacts, borders, items, group, names, least)),
        Lazy(partial(_merges, decided, merged, odds, terms, names)),
    )


def _contacts(
    borders: BorderStatistics,
    items: NDArray[np.float64],
    group: NDArray[np.int64],
    names: Sequence[str],
    least: float,
) -> Iterator[Contact]:
    ends, together = borders.labels - 1, group[borders.labels[:, 0]] == group[borders.labels[:, 1]]
    lengths = borders.sums[:, [SAMPLES, TOUCHING]].T.astype(np.int64)
    columns = ends, together, *lengths, np.round(items.sum(axis=1), DIGITS), items
    for (first, second), merged, length, touching, log_odds, terms in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        yield Contact(names[first], names[second], merged, length, touching, log_odds, _named(terms), least)


def _merges(
    decided: NDArray[np.int64],
    merged: NDArray[np.bool_],
    odds: NDArray[np.float64],
    terms: NDArray[np.float64],
    names: Sequence[str],
) -> Iterator[Merge]:
    columns = decided - 1, merged, np.round(odds, DIGITS), terms
    for (first, second), done, log_odds, renewed in zip(
        *(column.tolist() for column in columns), strict=True
    ):
        evidence = _named(renewed)
        # Of two leaves that were not merged the contact says everything.
        if done or evidence:
            yield Merge(names[first], names[second], done, log_odds, evidence)


def largest_first(
    groups: Iterable[list[int]], sizes: NDArray[np.int64], names: Sequence[str]
) -> tuple[SceneObject, ...]:
    """Make objects of groups of labels, given the size of each label, and the names of the leaves."""
    ordered = sorted(groups, key=lambda labels: (-sizes[labels].sum(), labels))
    return tuple(SceneObject(tuple(names[label - 1] for label in labels)) for labels in ordered)


def _named(items: Sequence[float]) -> dict[str, float]:
    found = dict(zip(ITEMS, items, strict=True))
    return {name: item for name, item in found.items() if item} if 0.0 in items else found
