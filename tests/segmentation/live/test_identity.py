"""Identities live as long as what they name."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nurbseg.segmentation.live.identity import Event, Identities, track_identities
from nurbseg.segmentation.points.registration import PointMap

SHAPE = (60, 80)
#: Left, top, width, height and tone.
Box = tuple[int, int, int, int, int]
Boxes = tuple[Box, ...]
DARK, LIGHT = (10, 10, 20, 20, 10), (50, 20, 15, 20, 240)


def scene(boxes: Boxes) -> tuple[np.ndarray, PointMap]:
    """Boxes before a wall, whose label is 1; each bears its own label, in their order."""
    labels = np.ones(SHAPE, np.uint16)
    depth_m = np.full(SHAPE, 2.0, np.float32)
    color = np.full((*SHAPE, 3), 128, np.uint8)
    for number, (left, top, width, height, tone) in enumerate(boxes, start=2):
        inside = slice(top, top + height), slice(max(left, 0), left + width)
        labels[inside], depth_m[inside] = number, 1.0
        color[inside] = (tone, 255 - tone, tone // 2)
    rows, columns = np.indices(SHAPE)
    points = np.dstack([(columns - 40) * depth_m / 80, (rows - 30) * depth_m / 80, depth_m])
    return labels, PointMap(points.astype(np.float32), color, np.ones(SHAPE, np.bool_))


def bar(*edges: int) -> Boxes:
    """A dark bar that is cut at all edges but the outer ones."""
    return tuple((left, 10, right - left, 20, 10) for left, right in pairwise(edges))


def tracked(*frames: Boxes, after: Identities | None = None) -> list[Identities]:
    """The identities of each frame."""
    found = []
    for boxes in frames:
        after = track_identities(after, *scene(boxes))
        found.append(after)
    return found


def test_labels_of_which_nothing_is_known_continue_nothing() -> None:
    labels, cloud = scene((DARK, LIGHT))
    found = track_identities(None, labels, cloud, before=labels)
    assert [event.kind for event in found.events] == ["new"] * 3


def test_a_segment_that_moves_keeps_its_identity_whatever_its_label() -> None:
    first, second = tracked((DARK, LIGHT), ((47, 22, 15, 20, 240), (14, 11, 20, 20, 10)))
    assert [second.of_label[label] for label in (1, 3, 2)] == [first.of_label[label] for label in (1, 2, 3)]
    assert second.events == ()


def rolling(left: int) -> Identities:
    """A box has moved four pixels a frame, four times, and was hidden for ten frames."""
    shown = [((left + 4 * frame, 20, 10, 20, 240),) for frame in range(4)]
    return tracked(*shown, *[()] * 10)[-1]


@pytest.mark.parametrize(
    ("start", "left", "same"),
    [
        # 44 pixels farther: where it is by now. Then where it was last, and on the way.
        (2, 58, True),
        (2, 14, True),
        (2, 28, True),
        # As far in the other direction.
        (58, 14, False),
    ],
)
def test_what_moved_while_it_was_hidden_is_known_on_its_way_and_nowhere_else(
    start: int, left: int, same: bool
) -> None:
    hidden = rolling(start)
    (now,) = tracked(((left, 20, 10, 20, 240),), after=hidden)
    assert (now.events == (Event("back", 2),)) == same
    assert (now.of_label[2] in hidden.known["identity"]) == same


def test_what_moves_on_may_change_its_color_more_than_what_jumps() -> None:
    state = tracked(*(((left, 20, 10, 10, 240),) for left in (2, 8, 14, 20)))[-1]
    # Nothing of it overlaps, and its color differs by 21.
    (on_its_way,) = tracked(((30, 20, 10, 10, 200),), after=state)
    assert (on_its_way.of_label[2], on_its_way.events) == (2, ())
    (off_its_way,) = tracked(((20, 30, 10, 10, 200),), after=state)
    assert off_its_way.of_label[2] != 2


@pytest.mark.parametrize(
    ("frames", "same"),
    [
        pytest.param([(LIGHT,), *[()] * 10, ((53, 20, 15, 20, 240),)], True, id="hidden"),
        pytest.param([(LIGHT,), (), ((50, 20, 15, 20, 10),)], False, id="another in its place"),
        pytest.param([(LIGHT,), *[()] * 31, (LIGHT,)], False, id="forgotten"),
        pytest.param(
            # What was seen of it at its best is what it is known by.
            [
                *(((50, 20, width, 20, 240),) for width in (16, 12, 8, 4)),
                (),
                ((52, 20, 5, 20, 240),),
            ],
            True,
            id="bit by bit",
        ),
        # The shade that its last part was in is not its color.
        pytest.param([(LIGHT,), ((50, 20, 14, 20, 10),), (), ((50, 29, 15, 20, 240),)], True, id="shade"),
    ],
)
def test_what_was_hidden_comes_back_as_itself_for_a_while(frames: list[Boxes], same: bool) -> None:
    found = tracked(*frames)
    before, identity = found[0].of_label[2], found[-1].of_label[2]
    assert before not in found[-2].of_label.values()
    assert (identity == before) == same
    assert (Event("back", identity) in found[-1].events) == same


def test_a_part_that_outgrows_the_rest_and_rejoins_it_takes_its_identity() -> None:
    # What hides the border between them moves on.
    first, *parted, joined = tracked(
        bar(20, 60), *(bar(20, edge, 60) for edge in (50, 46, 40, 34, 30)), bar(20, 60)
    )
    whole, part = first.of_label[2], parted[0].of_label[3]
    assert Event("split", part, whole) in parted[0].events
    assert {(state.of_label[2], state.of_label[3]) for state in parted} == {(whole, part)}
    assert joined.of_label[2] == whole
    assert joined.events == (Event("merge", part, whole),)


def test_parts_of_parts_rejoin_the_first_of_all() -> None:
    # The part is cut, too, and most of it becomes a part of the part.
    first, *states, joined = tracked(
        bar(20, 60),
        *(bar(20, edge, 60) for edge in (50, 44, 38, 32)),
        *(bar(20, 32, edge, 60) for edge in (52, 48, 44, 40, 36)),
        bar(20, 60),
    )
    whole, part, smallest = (states[-1].of_label[label] for label in (2, 3, 4))
    assert (whole, part) == (first.of_label[2], states[0].of_label[3])
    assert smallest not in (whole, part)
    assert joined.of_label[2] == whole
    assert {*joined.events} == {Event("merge", part, whole), Event("merge", smallest, whole)}


def test_a_part_of_a_forgotten_part_still_rejoins_the_whole() -> None:
    *_, parted = tracked(bar(10, 70), bar(10, 40, 70), bar(10, 40, 58, 70))
    whole, part, small = (parted.of_label[label] for label in (2, 3, 4))
    assert len({whole, part, small}) == 3
    # The middle is not seen for longer than it is remembered.
    ends = bar(10, 30) + bar(58, 70)
    *_, without = tracked(*[ends] * 40, after=parted)
    assert part not in without.known["identity"]
    *states, joined = tracked(
        *(bar(10, edge, 70) for edge in (50, 40, 30, 24, 20)), bar(10, 70), after=without
    )
    assert {(state.of_label[2], state.of_label[3]) for state in (without, *states)} == {(whole, small)}
    assert joined.of_label[2] == whole


def test_what_remained_visible_of_a_segment_is_that_segment_when_all_of_it_is_seen_again() -> None:
    # Something passes before it from right to left, and hides the larger part in the end.
    hidden = (
        ((10, 10, left - 10, 20, 10),) * (left > 10)
        + ((left, 5, 30, 40, 240), (left + 30, 10, 40 - left, 20, 10))
        for left in range(38, 4, -3)
    )
    first, *states, again = tracked(bar(10, 70), *hidden, bar(10, 70))
    whole, part = first.of_label[2], states[-1].of_label[3]
    assert part != whole
    assert again.of_label[2] == whole
    assert {Event("back", whole), Event("merge", part, whole)} <= {*again.events}


def test_a_piece_that_comes_back_far_from_the_middle_is_known_when_most_of_it_is_back() -> None:
    first, _, piece, *_, whole = tracked(bar(5, 75), (), *(bar(left, 75) for left in (67, 50, 30, 12)))
    # At first too far from where it was last to be it for sure.
    assert piece.of_label[2] != first.of_label[2] == whole.of_label[2]


def test_what_was_seen_beside_a_lost_segment_is_not_it_where_that_was() -> None:
    moving = (((left, 10, 12, 20, 100),) for left in (27, 24, 21, 18, 15, 12, 10))
    first, *states = tracked(((10, 10, 12, 20, 100), (30, 10, 12, 20, 100)), *moving)
    assert {state.of_label[2] for state in states} == {first.of_label[3]}
    assert first.of_label[2] in states[-1].known["identity"]


def test_of_two_that_were_never_one_the_larger_keeps_its_identity() -> None:
    other = ((40, 45, 5, 5, 200),)
    first, joined = tracked(other + bar(20, 30, 60), other + bar(20, 60))
    small, large = first.of_label[3], first.of_label[4]
    assert joined.of_label[3] == large
    assert joined.events == (Event("merge", small, large),)


def test_a_frame_without_segments_has_no_identities_and_forgets_none() -> None:
    _, cloud = scene(())
    (first,) = tracked((DARK,))
    state, lost = first, []
    for _ in range(200):
        state = track_identities(state, np.zeros(SHAPE, np.uint16), cloud)
        assert state.of_label == {}
        lost += [event.identity for event in state.events if event.kind == "lost"]
    assert sorted(lost) == sorted(first.of_label.values())
    assert tracked((DARK,), after=state)[0].of_label == first.of_label


def test_identities_are_reused_when_sixteen_bits_run_out() -> None:
    full = Identities({}, np.zeros(SHAPE, np.uint16), next_identity=65_535)
    (state,) = tracked((DARK,), after=full)
    assert sorted(state.of_label.values()) == [1, 65_535]
    assert tracked((DARK, LIGHT), after=replace(state, next_identity=65_535))[0].of_label[3] == 2


def test_a_sliver_between_the_pixels_of_the_grid_has_an_identity_too() -> None:
    labels = np.ones((480, 640), np.uint16)
    labels[101, 201:230] = 2
    points = np.ones((480, 640, 3), np.float32)
    cloud = PointMap(points, np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.bool_))
    found = track_identities(None, labels, cloud)
    assert found.of_label == {1: 1, 2: 2}
    # It comes and goes without a pixel of the grid: it is of no other segment.
    without = track_identities(found, np.ones((480, 640), np.uint16), cloud)
    assert without.events == (Event("lost", found.of_label[2]),)
    blue = PointMap(points, np.full((480, 640, 3), (0, 0, 255), np.uint8), cloud.valid)
    again = track_identities(without, labels, blue)
    assert again.events == (Event("new", again.of_label[2]),)


@given(st.integers(0, 2**32 - 1))
def test_no_two_segments_of_a_frame_share_an_identity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, cloud = scene(())
    state: Identities | None = None
    for _ in range(4):
        labels = np.repeat(np.repeat(rng.integers(0, 6, (6, 8)), 10, 0), 10, 1).astype(np.uint16)
        state = track_identities(state, labels, cloud)
        assert len(set(state.of_label.values())) == len(state.of_label)
        assert set(state.of_label) == set(np.unique(labels[labels > 0]))


def test_identities_go_along_with_what_is_known_of_the_motion() -> None:
    (first,) = tracked(((10, 10, 10, 10, 240),))
    labels, cloud = scene(((40, 30, 10, 10, 10),))
    assert track_identities(first, labels, cloud).of_label[2] != first.of_label[2]
    followed = track_identities(first, labels, cloud, before=labels)
    assert (followed.of_label, followed.events) == (first.of_label, ())
