"""Identities: which segment of a frame is which of the frame before."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nurbseg.common.compiled import I64, U16, Bool, Intp, compiled, inlined_once
from nurbseg.segmentation.labels.images import apply_lookup_table
from nurbseg.segmentation.live.appearance import (
    KNOWN,
    path_difference,
    place_difference,
    see_again,
    seen_segments,
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
        Every identity that is visible, or was recently, ascending.
    events : tuple of Event
        What changed since the frame before.
    next_identity : int
        The next unused one.
    places : mapping of int to Place
        Of the same identities as `known`.
    """

    of_label: Mapping[int, int]
    grid: NDArray[np.uint16]
    known: np.ndarray = field(default_factory=partial(np.zeros, 0, KNOWN))
    events: tuple[Event, ...] = ()
    next_identity: int = 1
    places: Mapping[int, Place] = field(default_factory=dict)


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
    known = previous.known
    common = _common_pixels(previous, before, whole_before, coarse, seen["label"])
    of_row = _matched(common, known, seen)
    _rejoin(known, common, of_row)
    (lost,) = (of_row == 0).nonzero()
    there = _at_places(previous, lost, coarse)
    order = np.argsort(-seen["pixels"], kind="stable")
    now, tables = np.zeros(seen.size, KNOWN), (known, seen, common)
    found = _continue(tables, of_row, (lost, *there), order, previous.next_identity, now)
    rows, is_best, into, next_identity = found

    identities = now["identity"].tolist()
    of_label = dict(zip(seen["label"][order].tolist(), identities, strict=True))
    events = []
    for row, identity, part_of in zip(rows.tolist(), identities, now["whole"].tolist(), strict=True):
        if row < 0:
            events.append(Event("split", identity, part_of) if part_of else Event("new", identity))
        elif known["unseen"][row]:
            events.append(Event("back", identity))
    is_hidden = np.ones(known.size, dtype=np.bool_)
    is_hidden[rows[rows >= 0]] = False
    hidden, into = known[is_hidden], into[is_hidden]
    is_gone = hidden["unseen"] == 0
    for identity, n in zip(hidden["identity"][is_gone].tolist(), into[is_gone].tolist(), strict=True):
        events.append(Event("merge", identity, identities[n]) if n >= 0 else Event("lost", identity))
    # While the camera is covered, nothing is forgotten.
    hidden["unseen"] = np.maximum(1, hidden["unseen"] + bool(identities))
    remembered = np.concatenate([now, hidden[hidden["unseen"] <= _REMEMBERED]])
    remembered = remembered[np.argsort(remembered["identity"])]
    _forget_wholes(remembered, known)
    best = zip(now["identity"][is_best].tolist(), seen["label"][order[is_best]].tolist(), strict=True)
    places = {**previous.places, **{identity: Place(label, coarse) for identity, label in best}}
    places = {identity: places[identity] for identity in remembered["identity"].tolist()}
    return Identities(of_label, coarse, remembered, tuple(events), next_identity, places)


def _common_pixels(
    previous: Identities,
    before: NDArray[np.uint16] | None,
    whole_before: NDArray[np.uint16] | None,
    coarse: NDArray[np.uint16],
    labels: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Count common pixels of what is known (rows) and the labels now (columns); the first of both is none."""
    row_of = np.zeros(max(previous.of_label, default=0) + 1, dtype=np.uint16)
    identities = [*previous.of_label.values()]
    row_of[[*previous.of_label]] = 1 + np.searchsorted(previous.known["identity"], identities)
    if before is None:
        before = previous.grid
    else:
        step = -(-before.shape[0] // coarse.shape[0])
        before = before[::step, ::step]
        row_of = row_of if whole_before is None else apply_lookup_table(row_of, whole_before)
    column_of = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.uint16)
    column_of[labels] = np.arange(1, labels.size + 1)
    counts = np.zeros((previous.known.size + 1, labels.size + 1), dtype=np.int64)
    _count_common(apply_lookup_table(row_of, before), apply_lookup_table(column_of, coarse), counts)
    return counts


@compiled
def _count_common(rows: U16, columns: U16, counts: I64) -> None:
    height, width = rows.shape
    for r in range(height):
        for c in range(width):
            counts[rows[r, c], columns[r, c]] += 1


def _matched(common: NDArray[np.int64], known: np.ndarray, seen: np.ndarray) -> NDArray[np.intp]:
    """Return the column that continues each known segment; 0 for none."""
    of_row = np.zeros(known.size, dtype=np.intp)
    (visible,) = (known["unseen"] == 0).nonzero()
    own = common[1 + visible, 1:]
    if own.size == 0:
        return of_row
    # Only pixels labeled in both frames count: others came into view or left it.
    before = np.minimum(known["pixels"][visible], own.sum(axis=1))
    union = before[:, np.newaxis] + np.minimum(seen["pixels"], own.sum(axis=0)) - own
    score = own / np.maximum(union, 1)
    # Imported late: it takes long, and a single frame does not need it.
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-score)
    is_enough = score[rows, columns] >= _OVERLAP_MIN
    of_row[visible[rows[is_enough]]] = columns[is_enough] + 1
    return of_row


@compiled
def _row_of(known: Any, identity: int) -> int:
    """Return the row of an identity; -1 if nothing is known of it."""
    for row in range(known.size):
        if known[row]["identity"] == identity:
            return row
    return -1


@compiled
def _most(counts: I64) -> int:
    """Return the place of the largest count but the first, if it is a large enough share of all; else 0."""
    most = 0
    for n in range(1, counts.size):
        if most == 0 or counts[n] > counts[most]:
            most = n
    return most if counts[most] >= max(1.0, _TAKEN_SHARE * counts.sum()) else 0


@compiled
def _rejoin(known: Any, common: I64, of_row: Intp) -> None:
    """Where a part has rejoined what it was split from, give its column to that."""
    matched = of_row.copy()
    for part in range(known.size):
        column, at = matched[part], part
        while column > 0 and known[at]["whole"] > 0:
            # The whole may be a part itself; the oldest counts.
            at = _row_of(known, known[at]["whole"])
            if of_row[at] == 0 and _most(common[at + 1]) == column:
                of_row[of_row == column] = 0
                of_row[at] = column


def _at_places(
    previous: Identities, lost: NDArray[np.intp], coarse: NDArray[np.uint16]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the number of pixels of lost segments at their best, the most common label there, and its."""
    pixels = [previous.places[each].pixels for each in previous.known["identity"][lost].tolist()]
    sizes = np.array([each.size for each in pixels], dtype=np.int64)
    labels, counts = np.zeros((2, lost.size), dtype=np.int64)
    if pixels:
        _most_common(coarse.reshape(-1)[np.concatenate(pixels)], sizes, labels, counts)
    return sizes, labels, counts


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


@compiled
def _continue(
    tables: tuple[Any, Any, I64],
    of_row: Intp,
    lost: tuple[Intp, I64, I64, I64],
    order: Intp,
    next_identity: int,
    now: Any,
) -> tuple[Intp, Bool, Intp, int]:
    """Find what each segment is, the largest first, and what became of those that are no longer visible.

    Parameters
    ----------
    tables : (K,) KNOWN, (S,) SEEN and (K + 1, S + 1) int64
        What is known, what is seen, and their common pixels.
    of_row : (K,) intp
        Column of each known segment; 0 for none. Changed to what is found.
    lost : (L,) intp and three times (L,) int64
        Known segments without a column, and what is at their places.
    order : (S,) intp
        Of the segments that are seen.
    next_identity : int
        The next unused one.
    now : (S,) KNOWN
        Filled in, in this order.

    Returns
    -------
    rows, is_best : (S,) intp, (S,) bool
        What each was before, -1 for a new one; and whether it is seen at its best.
    into : (K,) intp
        With which each known one shares most of its pixels, -1 for none.
    next_identity : int
        The next unused one.
    """
    known, seen, common = tables
    rows, is_best = np.empty(seen.size, dtype=np.intp), np.empty(seen.size, dtype=np.bool_)
    into = np.empty(known.size, dtype=np.intp)
    _uncover(known, seen, lost, of_row)
    row_of = np.full(seen.size, -1)
    for row in range(known.size):
        if of_row[row] > 0:
            row_of[of_row[row] - 1] = row
    for k in range(order.size):
        n = order[k]
        if row_of[n] < 0:
            least = np.inf
            for row in range(known.size):
                difference = path_difference(seen[n], known[row]) if of_row[row] == 0 else np.inf
                if difference <= 1.0 and difference < least:
                    least, row_of[n] = difference, row
        rows[k] = row_of[n]
        if rows[k] >= 0:
            now[k], of_row[rows[k]] = known[rows[k]], n + 1
            continue
        while (
            next_identity > _IDENTITY_MAX
            or _row_of(known, next_identity) >= 0
            or _row_of(now[:k], next_identity) >= 0
        ):
            next_identity = next_identity + 1 if next_identity < _IDENTITY_MAX else 1
        part_of = _most(common[:, n + 1])
        now[k]["identity"], now[k]["whole"] = (
            next_identity,
            known[part_of - 1]["identity"] if part_of > 0 else 0,
        )
        next_identity += 1
    for k in range(order.size):
        is_best[k] = see_again(now[k], seen[order[k]])
        if is_best[k]:
            now[k]["best_next_identity"] = next_identity
    place_of = np.argsort(order)
    for row in range(known.size):
        column = _most(common[row + 1])
        into[row] = place_of[column - 1] if column > 0 else -1
    return rows, is_best, into, next_identity


@inlined_once
def _uncover(known: Any, seen: Any, lost: tuple[Intp, I64, I64, I64], of_row: Intp) -> None:
    """Give columns to lost segments that were there at their best, and look the same.

    What was hidden may come back piece by piece, or as part of what remained of it: pieces that were new
    then are what they were before.
    """
    rows, sizes, labels, counts = lost
    owner = np.full(seen.size, -1)
    for row in range(known.size):
        if of_row[row] > 0:
            owner[of_row[row] - 1] = row
    is_given = np.zeros(seen.size, dtype=np.bool_)
    for k in range(rows.size):
        back, n = known[rows[k]], np.searchsorted(seen["label"], labels[k])
        if n == seen.size or seen[n]["label"] != labels[k] or is_given[n]:
            continue
        if (
            counts[k] < _PLACE_MIN * (sizes[k] + seen[n]["pixels"] - counts[k])
            or place_difference(seen[n], back) > 1.0
        ):
            continue
        # Who was there beside it is somebody else.
        if owner[n] < 0 or known[owner[n]]["identity"] >= back["best_next_identity"]:
            of_row[of_row == n + 1] = 0
            of_row[rows[k]], is_given[n] = n + 1, True


@compiled
def _forget_wholes(known: Any, before: Any) -> None:
    """Replace wholes that are no longer known by what they were split from."""
    for n in range(known.size):
        while known[n]["whole"] > 0 and _row_of(known, known[n]["whole"]) < 0:
            row = _row_of(before, known[n]["whole"])
            known[n]["whole"] = before[row]["whole"] if row >= 0 else 0
