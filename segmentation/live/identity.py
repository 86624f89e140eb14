"""Identities: which segment of a frame is which of the frame before."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nurbseg.segmentation.labels.images import apply_lookup_table
from nurbseg.segmentation.live.appearance import (
    Appearance,
    appearances_of,
    best_match,
    looks_like,
    updated,
)
from nurbseg.segmentation.points.registration import PointMap

#: Identities fit into a label image of 16 bits; 0 is "no segment".
_IDENTITY_MAX = np.iinfo(np.uint16).max
#: Least overlap (intersection over union) of the same segment in two frames.
_OVERLAP_MIN = 0.2
#: Least share of a segment that changes its identity for a split or a merge to be reported.
_TAKEN_SHARE = 0.3
#: Frames for which a lost identity is kept, of those that show anything.
_REMEMBERED = 30
#: Least overlap (intersection over union) with where a lost segment was to be seen at its best.
_PLACE_MIN = 0.5
#: Pixels of the image are compared on a grid of about this width.
_GRID_WIDTH = 160


#: Why a frame is segmented from scratch that does not continue the one before, by what it says of itself.
NEW_SEQUENCE = "numbers or stamps that go back"


@dataclass(frozen=True, slots=True)
class Event:
    """What happened to an identity between two frames.

    Parameters
    ----------
    kind : {"new", "lost", "back", "split", "merge", "restart"}
        "split": `identity` was split from `other`; "merge": `identity` was merged into `other`; "restart":
        a new sequence of frames begins.
    identity : int
        The identity; 0 of a new sequence.
    other : int or None
        The second one of a split or a merge.
    """

    kind: Literal["new", "lost", "back", "split", "merge", "restart"]
    identity: int
    other: int | None = None


def event_text(event: Event) -> str:
    """Return an event as text."""
    texts = {
        "new": f"{event.identity} is new",
        "lost": f"{event.identity} is lost",
        "back": f"{event.identity} is back",
        "split": f"{event.identity} split from {event.other}",
        "merge": f"{event.identity} merged into {event.other}",
        "restart": "a new sequence begins",
    }
    return texts[event.kind]


@dataclass(frozen=True, eq=False)
class Extent:
    """Where a segment was when most of it was seen.

    Parameters
    ----------
    grid : (h, w) uint16
        Labels of that frame.
    label : int
        The segment's.
    appearance : Appearance
        What was seen of it.
    next_identity : int
        The next unused one then.
    """

    grid: NDArray[np.uint16]
    label: int
    appearance: Appearance
    next_identity: int

    @cached_property
    def pixels(self) -> NDArray[np.intp]:
        """Its pixels on the grid, flat."""
        return np.flatnonzero(self.grid == self.label)


@dataclass(frozen=True, slots=True, eq=False)
class Identities:
    """The identities of a frame's segments, and of those seen shortly before.

    Parameters
    ----------
    of_label : mapping of int to int
        Identity of each label of the frame's label image.
    grid : (h, w) uint16
        Label of every few pixels, for the comparison with the next frame.
    appearances : mapping of int to Appearance
        Of every identity that is visible, or was recently.
    events : tuple of Event
        What changed since the frame before.
    next_identity : int
        The next unused one.
    split_from : mapping of int to int
        Of identities that were split from others: from which.
    extents : mapping of int to Extent
        Of the same identities as `appearances`.
    """

    of_label: Mapping[int, int]
    grid: NDArray[np.uint16]
    appearances: Mapping[int, Appearance] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    next_identity: int = 1
    split_from: Mapping[int, int] = field(default_factory=dict)
    extents: Mapping[int, Extent] = field(default_factory=dict)

    def image(self, labels: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return a label image of identities.

        Parameters
        ----------
        labels : (H, W) uint16
            The frame's labels; 0 stays 0.
        """
        table = np.zeros(max(self.of_label, default=0) + 1, dtype=np.uint16)
        table[[*self.of_label]] = [*self.of_label.values()]
        return apply_lookup_table(table, labels)


def track_identities(
    previous: Identities | None,
    labels: NDArray[np.uint16],
    cloud: PointMap,
    *,
    before: NDArray[np.uint16] | None = None,
    wholes: tuple[NDArray[np.uint16], NDArray[np.uint16]] | None = None,
) -> Identities:
    """Give each segment the identity of the segment of the frame before that it continues.

    Segments are matched by the assignment with the greatest total overlap in the image. Those without a match
    are compared with unmatched and recently lost ones by position, motion, size and color; those that
    resemble none are new.

    Parameters
    ----------
    previous : Identities or None
        Of the frame before; None for the first.
    labels : (H, W) uint16
        Labels of this frame; 0 is no segment.
    cloud : PointMap
        This frame.
    before : (H, W) uint16, optional
        Labels of the frame before, warped to this one; 0 is none. By default segments are assumed not to
        have moved.
    wholes : ((N,) uint16, (M,) uint16), optional
        What each label of this frame, and of `before`, is a part of, if segments have several labels.

    Returns
    -------
    Identities
        Of this frame.
    """
    step = max(1, round(labels.shape[1] / _GRID_WIDTH))
    every = np.arange(int(labels.max(initial=0)) + 1, dtype=np.uint16)
    whole, whole_before = (every, None) if wholes is None else wholes
    coarse = apply_lookup_table(whole, labels[::step, ::step])
    every = np.unique(whole)
    seen = appearances_of(labels, whole, every, cloud, step)
    between = [int(each) for each in every if each and each not in seen]
    if between:
        # Slivers between the grid's pixels.
        seen |= appearances_of(labels, whole, between, cloud, 1)
    if previous is None or previous.grid.shape != coarse.shape:
        previous = Identities({}, np.zeros_like(coarse))
    labels_before = previous.grid if before is None else before[::step, ::step]
    if before is not None and whole_before is not None:
        labels_before = apply_lookup_table(whole_before, labels_before)
    identities = np.array([0, *sorted(previous.of_label.values())])
    present = np.array([0, *sorted(seen)])
    overlap = _overlap(labels_before, coarse, previous.of_label, identities, present)
    matched = _matched(overlap, identities, present, previous, seen)
    matched = _rejoined(matched, overlap, identities, present, previous.split_from)
    matched |= _uncovered(matched, coarse, seen, previous)

    events: list[Event] = []
    taken = set(matched.values())
    free = {each: lost for each, lost in previous.appearances.items() if each not in taken}
    next_identity = previous.next_identity
    of_label: dict[int, int] = {}
    split_from = dict(previous.split_from)
    for label in sorted(seen, key=lambda each: -seen[each].pixels):
        if label in matched:
            of_label[label] = matched[label]
            if previous.appearances[matched[label]].unseen:
                events.append(Event("back", matched[label]))
            continue
        known = best_match(seen[label], free)
        if known is not None:
            del free[known]
            of_label[label] = known
            if previous.appearances[known].unseen:
                events.append(Event("back", known))
            continue
        identity, next_identity = _fresh(next_identity, previous.appearances, of_label)
        of_label[label] = identity
        parent = _most(overlap[:, np.searchsorted(present, label)], identities)
        events.append(Event("new", identity) if parent is None else Event("split", identity, parent))
        if parent is not None:
            split_from[identity] = parent

    appearances = {
        identity: updated(previous.appearances.get(identity), seen[label])
        for label, identity in of_label.items()
    }
    for identity, appearance in previous.appearances.items():
        if identity in appearances:
            continue
        # While the camera is covered, nothing is forgotten.
        unseen = max(1, appearance.unseen + bool(seen))
        if appearance.unseen == 0:
            into = _most(overlap[np.searchsorted(identities, identity)], present)
            into = None if into is None else of_label.get(into)
            events.append(Event("lost", identity) if into is None else Event("merge", identity, into))
        if unseen <= _REMEMBERED:
            kept = appearance.center_m, appearance.color_lab, appearance.pixels
            appearances[identity] = Appearance(*kept, unseen, appearance.motion_m)
    split_from = _remembered(split_from, appearances)
    extents = {identity: extent for identity, extent in previous.extents.items() if identity in appearances}
    for label, identity in of_label.items():
        if seen[label].pixels >= appearances[identity].pixels:
            extents[identity] = Extent(coarse, label, seen[label], next_identity)
    return Identities(of_label, coarse, appearances, tuple(events), next_identity, split_from, extents)


def _overlap(
    before: NDArray[np.uint16],
    now: NDArray[np.uint16],
    of_label: Mapping[int, int],
    identities: NDArray[np.intp],
    present: NDArray[np.intp],
) -> NDArray[np.int64]:
    """Count common pixels of identities, given those of the labels before (rows), and labels (columns)."""
    row_of = np.zeros(1 + max(int(before.max(initial=0)), *of_label, 0), dtype=np.intp)
    row_of[[*of_label]] = np.searchsorted(identities, [*of_label.values()])
    cells = row_of[before] * present.size + np.searchsorted(present, np.arange(present[-1] + 1))[now]
    counts = np.bincount(cells.reshape(-1), minlength=identities.size * present.size)
    return counts.reshape(identities.size, present.size)


def _matched(
    overlap: NDArray[np.int64],
    identities: NDArray[np.intp],
    present: NDArray[np.intp],
    previous: Identities,
    seen: Mapping[int, Appearance],
) -> dict[int, int]:
    """Return the identity of each label that continues one."""
    common = overlap[1:, 1:]
    if common.size == 0:
        return {}
    before = np.array([previous.appearances[int(identity)].pixels for identity in identities[1:]])
    now = np.array([seen[int(each)].pixels for each in present[1:]])
    # Only pixels labeled in both frames count: others came into view or left it.
    both_before, both_now = common.sum(axis=1), common.sum(axis=0)
    union = np.minimum(before, both_before)[:, None] + np.minimum(now, both_now)[None, :] - common
    score = common / np.maximum(union, 1)
    # Imported late: it takes long, and a single frame does not need it.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-score)
    return {
        int(present[1 + column]): int(identities[1 + row])
        for row, column in zip(rows, columns, strict=True)
        if score[row, column] >= _OVERLAP_MIN
    }


def _rejoined(
    matched: Mapping[int, int],
    overlap: NDArray[np.int64],
    identities: NDArray[np.intp],
    present: NDArray[np.intp],
    split_from: Mapping[int, int],
) -> dict[int, int]:
    """Return the identity of each label: where a part has rejoined what it was split from, that one's."""
    found = dict(matched)
    for label, part in matched.items():
        whole = split_from.get(part)
        while whole is not None:
            is_free = whole in identities and whole not in found.values()
            if is_free and _most(overlap[np.searchsorted(identities, whole)], present) == label:
                found[label] = whole
            # The whole may be a part itself; the oldest counts.
            whole = split_from.get(whole)
    return found


def _uncovered(
    matched: Mapping[int, int],
    grid: NDArray[np.uint16],
    seen: Mapping[int, Appearance],
    previous: Identities,
) -> dict[int, int]:
    """Return the lost identities of labels that are where these were, and look the same.

    What was hidden may come back piece by piece, or as part of what remained of it: pieces that were new
    then are what they were before.
    """
    found: dict[int, int] = {}
    flat = grid.reshape(-1)
    for identity in sorted(previous.appearances.keys() - {*matched.values()}):
        extent = previous.extents[identity]
        count = np.bincount(flat[extent.pixels], minlength=2)
        label = int(count[1:].argmax()) + 1
        if label in found or label not in seen:
            continue
        union = extent.pixels.size + seen[label].pixels - count[label]
        # Who was there beside it is somebody else.
        is_newer = matched.get(label, extent.next_identity) >= extent.next_identity
        if is_newer and count[label] >= _PLACE_MIN * union and looks_like(seen[label], extent.appearance):
            found[label] = identity
    return found


def _remembered(split_from: Mapping[int, int], known: Collection[int]) -> dict[int, int]:
    """Return from which identity that is still known each of them was split."""
    found = {}
    for part in split_from.keys() & set(known):
        whole: int | None = split_from[part]
        while whole is not None and whole not in known:
            whole = split_from.get(whole)
        if whole is not None:
            found[part] = whole
    return found


def _fresh(
    next_identity: int, remembered: Mapping[int, Appearance], given: Mapping[int, int]
) -> tuple[int, int]:
    """Return an unused identity, and the next one to try."""
    taken = {*remembered, *given.values()}
    while next_identity in taken or next_identity > _IDENTITY_MAX:
        next_identity = 1 if next_identity >= _IDENTITY_MAX else next_identity + 1
    return next_identity, next_identity + 1


def _most(counts: NDArray[np.int64], values: NDArray[np.intp]) -> int | None:
    """Return the value, but for 0, with the largest count, if that is a large enough share of all."""
    most = int(counts[1:].argmax()) + 1 if counts.size > 1 else 0
    return int(values[most]) if most and counts[most] >= max(1, _TAKEN_SHARE * counts.sum()) else None
