"""Identities: which segment of a frame is which of the frame before."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import I64, U16, compiled
from nurbseg.segmentation.labels.images import apply_lookup_table
from nurbseg.segmentation.live.appearance import (
    KNOWN,
    path_differences,
    place_differences,
    seen_segments,
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
class Place:
    """Where a segment was when most of it was seen: its label, and the labels of that frame's grid."""

    label: int
    grid: NDArray[np.uint16]

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
    known : (K,) KNOWN
        Every identity that is visible, or was recently; see `nurbseg.segmentation.live.appearance`.
    events : tuple of Event
        What changed since the frame before.
    next_identity : int
        The next unused one.
    split_from : mapping of int to int
        Of identities that were split from others: from which.
    places : mapping of int to Place
        Of the same identities as `known`.
    """

    of_label: Mapping[int, int]
    grid: NDArray[np.uint16]
    known: np.ndarray = field(default_factory=partial(np.zeros, 0, KNOWN))
    events: tuple[Event, ...] = ()
    next_identity: int = 1
    split_from: Mapping[int, int] = field(default_factory=dict)
    places: Mapping[int, Place] = field(default_factory=dict)

    def image(self, labels: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Return a label image of identities.

        Parameters
        ----------
        labels : (H, W) uint16
            The frame's labels; 0 stays 0.
        """
        return apply_lookup_table(_table(self.of_label), labels)


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
    seen = seen_segments(labels, whole, cloud, step)
    if previous is None or previous.grid.shape != coarse.shape:
        previous = Identities({}, np.zeros_like(coarse))
    known, next_identity = previous.known, previous.next_identity
    row_of = {identity: row for row, identity in enumerate(known["identity"].tolist())}
    visible = [0, *sorted(previous.of_label.values())]
    overlap = _overlap(previous, visible, before, whole_before, coarse, seen["label"])
    of_column = _matched(
        overlap, visible, known["pixels"][[row_of[each] for each in visible[1:]]], seen["pixels"]
    )
    of_column = _rejoined(of_column, overlap, visible, previous.split_from)
    of_column |= _uncovered(of_column, coarse, seen, previous)

    events: list[Event] = []
    identities: list[int] = []
    split_from, taken, given = dict(previous.split_from), {*of_column.values()}, {*row_of}
    order = np.argsort(-seen["pixels"], kind="stable")
    free = [row for identity, row in row_of.items() if identity not in taken]
    new = [n for n in order.tolist() if n + 1 not in of_column]
    difference = path_differences(seen[new], known[free])
    unseen = known["unseen"].tolist()
    for n in order.tolist():
        identity = of_column.get(n + 1, 0)
        if not identity and free:
            best = int(difference[new.index(n)].argmin())
            if difference[new.index(n), best] <= 1.0:
                identity = int(known["identity"][free[best]])
                difference[:, best] = np.inf
        if not identity:
            identity, next_identity = _fresh(next_identity, given)
            given.add(identity)
            parent = visible[_most(overlap[:, n + 1])]
            events.append(Event("split", identity, parent) if parent else Event("new", identity))
            split_from |= {identity: parent} if parent else {}
        elif unseen[row_of[identity]]:
            events.append(Event("back", identity))
        identities.append(identity)
    seen = seen[order]
    of_label = dict(zip(seen["label"].tolist(), identities, strict=True))

    now = updated(known, np.array([row_of.get(each, -1) for each in identities], dtype=np.intp), seen)
    is_best = seen["pixels"] >= now["pixels"]
    now["identity"] = identities
    now["best_center_m"][is_best] = seen["center_m"][is_best]
    now["best_color_lab"][is_best] = seen["color_lab"][is_best]
    now["best_next_identity"][is_best] = next_identity
    given = {*identities}
    hidden = known[[row for identity, row in row_of.items() if identity not in given]]
    for identity in hidden["identity"][hidden["unseen"] == 0].tolist():
        into = _most(overlap[visible.index(identity)])
        event = (
            Event("merge", identity, identities[order.tolist().index(into - 1)])
            if into
            else Event("lost", identity)
        )
        events.append(event)
    # While the camera is covered, nothing is forgotten.
    hidden["unseen"] = np.maximum(1, hidden["unseen"] + bool(identities))
    known = np.concatenate([now, hidden[hidden["unseen"] <= _REMEMBERED]])
    remembered = {*known["identity"].tolist()}
    places = {each: place for each, place in previous.places.items() if each in remembered}
    places |= {identities[n]: Place(int(seen["label"][n]), coarse) for n in is_best.nonzero()[0].tolist()}
    split_from = _remembered(split_from, remembered)
    return Identities(of_label, coarse, known, tuple(events), next_identity, split_from, places)


def _table(of_label: Mapping[int, int]) -> NDArray[np.uint16]:
    """Return the identity of each label as a table; 0 for none."""
    table = np.zeros(max(of_label, default=0) + 1, dtype=np.uint16)
    table[[*of_label]] = [*of_label.values()]
    return table


def _overlap(
    previous: Identities,
    visible: Sequence[int],
    before: NDArray[np.uint16] | None,
    whole_before: NDArray[np.uint16] | None,
    coarse: NDArray[np.uint16],
    labels: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Count common pixels of the identities before (rows) and the labels now (columns); the first is none."""
    row_of = np.searchsorted(visible, _table(previous.of_label)).astype(np.uint16)
    if before is None:
        before = previous.grid
    else:
        step = -(-before.shape[0] // coarse.shape[0])
        before = before[::step, ::step]
        row_of = row_of if whole_before is None else apply_lookup_table(row_of, whole_before)
    column_of = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.uint16)
    column_of[labels] = np.arange(1, labels.size + 1)
    counts = np.zeros((len(visible), labels.size + 1), dtype=np.int64)
    _count_common(apply_lookup_table(row_of, before), apply_lookup_table(column_of, coarse), counts)
    return counts


@compiled
def _count_common(rows: U16, columns: U16, counts: I64) -> None:
    height, width = rows.shape
    for r in range(height):
        for c in range(width):
            counts[rows[r, c], columns[r, c]] += 1


def _matched(
    overlap: NDArray[np.int64],
    visible: Sequence[int],
    sizes_before: NDArray[np.int64],
    sizes: NDArray[np.int64],
) -> dict[int, int]:
    """Return the identity of each column that continues one."""
    common = overlap[1:, 1:]
    if common.size == 0:
        return {}
    # Only pixels labeled in both frames count: others came into view or left it.
    both_before, both_now = common.sum(axis=1), common.sum(axis=0)
    union = np.minimum(sizes_before, both_before)[:, None] + np.minimum(sizes, both_now)[None, :] - common
    score = common / np.maximum(union, 1)
    # Imported late: it takes long, and a single frame does not need it.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-score)
    is_enough = score[rows, columns] >= _OVERLAP_MIN
    pairs = zip(rows[is_enough].tolist(), columns[is_enough].tolist(), strict=True)
    return {column + 1: visible[row + 1] for row, column in pairs}


def _rejoined(
    of_column: Mapping[int, int],
    overlap: NDArray[np.int64],
    visible: Sequence[int],
    split_from: Mapping[int, int],
) -> dict[int, int]:
    """Return the identity of each column: where a part has rejoined what it was split from, that one's."""
    found = dict(of_column)
    for column, part in of_column.items():
        whole = split_from.get(part)
        while whole is not None:
            is_free = whole in visible and whole not in found.values()
            if is_free and _most(overlap[visible.index(whole)]) == column:
                found[column] = whole
            # The whole may be a part itself; the oldest counts.
            whole = split_from.get(whole)
    return found


def _uncovered(
    of_column: Mapping[int, int], coarse: NDArray[np.uint16], seen: np.ndarray, previous: Identities
) -> dict[int, int]:
    """Return the lost identities of columns that are where these were, and look the same.

    What was hidden may come back piece by piece, or as part of what remained of it: pieces that were new
    then are what they were before.
    """
    taken = {*of_column.values()}
    is_lost = [identity not in taken for identity in previous.known["identity"].tolist()]
    lost = np.sort(previous.known[is_lost], order="identity") if seen.size else previous.known[:0]
    if not lost.size:
        return {}
    pixels = [previous.places[identity].pixels for identity in lost["identity"].tolist()]
    sizes = np.array([each.size for each in pixels])
    labels, counts = np.zeros((2, lost.size), dtype=np.int64)
    _most_common(coarse.reshape(-1)[np.concatenate(pixels)], sizes, labels, counts)
    columns = np.searchsorted(seen["label"], labels)
    here = seen[columns.clip(max=seen.size - 1)]
    is_back = (here["label"] == labels) & (counts >= _PLACE_MIN * (sizes + here["pixels"] - counts))
    is_back &= place_differences(here, lost) <= 1.0
    found: dict[int, int] = {}
    for column, known in zip((columns[is_back] + 1).tolist(), lost[is_back].tolist(), strict=True):
        identity, first_newer = known[0], known[-1]
        # Who was there beside it is somebody else.
        if of_column.get(column, first_newer) >= first_newer:
            found.setdefault(column, identity)
    return found


@compiled
def _most_common(values: U16, sizes: I64, labels: I64, counts: I64) -> None:
    """Find the most common of the values in a row that belong together, but for 0, and its number."""
    found, begin = np.zeros(1 + (values.max() if values.size else 0), dtype=np.int64), 0
    for n in range(sizes.size):
        found[:] = 0
        for value in values[begin : begin + sizes[n]]:
            found[value] += 1
        found[0] = 0
        labels[n] = np.argmax(found)
        counts[n] = found[labels[n]]
        begin += sizes[n]


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


def _fresh(next_identity: int, taken: Collection[int]) -> tuple[int, int]:
    """Return an unused identity, and the next one to try."""
    while next_identity in taken or next_identity > _IDENTITY_MAX:
        next_identity = 1 if next_identity >= _IDENTITY_MAX else next_identity + 1
    return next_identity, next_identity + 1


def _most(counts: NDArray[np.int64]) -> int:
    """Return the place of the largest count but the first, if it is a large enough share of all; else 0."""
    most = int(counts[1:].argmax()) + 1 if counts.size > 1 else 0
    return most if counts[most] >= max(1, _TAKEN_SHARE * counts.sum()) else 0
