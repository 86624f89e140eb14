"""Identities live as long as what they name."""

from dataclasses import replace
from unittest import mock

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nurbseg.segmentation.live import identity
from nurbseg.segmentation.live.appearance import Appearance, appearances_of, updated
from nurbseg.segmentation.live.identity import Event, Identities, track_identities
from nurbseg.segmentation.points.registration import PointMap

SHAPE = (60, 80)


def scene(*boxes: tuple[int, int, int, int, int]) -> tuple[np.ndarray, PointMap]:
    """Boxes (left, top, width, height, tone) before a wall; each bears its own label, in their order."""
    labels = np.ones(SHAPE, np.uint16)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth_m = np.full(SHAPE, 2.0, np.float32)
    color = np.full((*SHAPE, 3), 128, np.uint8)
    for number, (left, top, width, height, tone) in enumerate(boxes, start=2):
        inside = (columns >= left) & (columns < left + width) & (rows >= top) & (rows < top + height)
        labels[inside] = number
        depth_m[inside] = 1.0
        color[inside] = (tone, 255 - tone, tone // 2)
    points = np.dstack([(columns - 40) * depth_m / 80, (rows - 30) * depth_m / 80, depth_m])
    return labels, PointMap(points.astype(np.float32), color, np.ones(SHAPE, np.bool_))


def test_labels_of_which_nothing_is_known_continue_nothing() -> None:
    labels, cloud = scene((10, 10, 20, 20, 10), (50, 20, 15, 20, 240))
    found = track_identities(None, labels, cloud, before=labels)
    assert [event.kind for event in found.events] == ["new"] * 3


def test_a_segment_that_moves_keeps_its_identity_whatever_its_label() -> None:
    labels, cloud = scene((10, 10, 20, 20, 10), (50, 20, 15, 20, 240))
    first = track_identities(None, labels, cloud)
    moved, cloud = scene((47, 22, 15, 20, 240), (14, 11, 20, 20, 10))
    second = track_identities(first, moved, cloud)
    assert second.of_label[2] == first.of_label[3]
    assert second.of_label[3] == first.of_label[2]
    assert second.of_label[1] == first.of_label[1]
    assert second.events == ()


def test_a_segment_that_was_hidden_comes_back_as_itself() -> None:
    labels, cloud = scene((10, 10, 20, 20, 10), (50, 20, 15, 20, 240))
    first = track_identities(None, labels, cloud)
    state = first
    for _ in range(10):
        state = track_identities(state, *scene((10, 10, 20, 20, 10)))
    assert first.of_label[3] not in state.of_label.values()
    back = track_identities(state, *scene((10, 10, 20, 20, 10), (53, 20, 15, 20, 240)))
    assert back.of_label[3] == first.of_label[3]
    assert back.events == (Event("back", first.of_label[3]),)


def rolling(left: int, frames: int) -> Identities:
    """Return the identities after a box has moved four pixels a frame, and was hidden for ten."""
    state = None
    for frame in range(frames):
        state = track_identities(state, *scene((left + 4 * frame, 20, 10, 20, 240)))
    for _ in range(10):
        state = track_identities(state, *scene())
    assert state is not None
    return state


def test_what_moved_while_it_was_hidden_is_known_on_its_way_and_nowhere_else() -> None:
    state = rolling(2, 4)
    # 44 pixels farther: where it is by now. Then where it was last, and as far in the other direction.
    for left, same in ((58, True), (14, True), (36, True)):
        now = track_identities(state, *scene((left, 20, 10, 20, 240)))
        assert (now.events == (Event("back", 2),)) == same
    on_its_way = track_identities(state, *scene((58, 20, 10, 20, 240)))
    assert np.allclose(on_its_way.appearances[2].motion_m, (0.05, 0.0, 0.0), atol=0.004)
    state = rolling(58, 4)
    now = track_identities(state, *scene((14, 20, 10, 20, 240)))
    assert now.of_label[2] not in state.appearances


def test_what_moves_on_may_change_its_color_more_than_what_jumps() -> None:
    state = None
    for left in (2, 8, 14, 20):
        state = track_identities(state, *scene((left, 20, 10, 10, 240)))
    # Nothing of it overlaps, and its color differs by 21.
    on_its_way = track_identities(state, *scene((30, 20, 10, 10, 200)))
    assert on_its_way.of_label[2] == 2
    assert on_its_way.events == ()
    off_its_way = track_identities(state, *scene((20, 30, 10, 10, 200)))
    assert off_its_way.of_label[2] != 2


def test_another_thing_in_its_place_is_new() -> None:
    first = track_identities(None, *scene((50, 20, 15, 20, 240)))
    gone = track_identities(first, *scene())
    other = track_identities(gone, *scene((50, 20, 15, 20, 10)))
    assert other.of_label[2] not in first.of_label.values()


def test_a_forgotten_segment_is_new() -> None:
    state = first = track_identities(None, *scene((50, 20, 15, 20, 240)))
    for _ in range(31):
        state = track_identities(state, *scene())
    again = track_identities(state, *scene((50, 20, 15, 20, 240)))
    assert again.of_label[2] != first.of_label[2]


def test_splits_and_merges_are_reported_with_both_identities() -> None:
    whole = track_identities(None, *scene((10, 10, 40, 20, 100)))
    parted = track_identities(whole, *scene((10, 10, 26, 20, 100), (36, 10, 14, 20, 100)))
    assert parted.of_label[2] == whole.of_label[2]
    assert parted.events == (Event("split", parted.of_label[3], whole.of_label[2]),)
    adjacency = track_identities(parted, *scene((10, 10, 40, 20, 100)))
    assert adjacency.of_label[2] == whole.of_label[2]
    assert adjacency.events == (Event("merge", parted.of_label[3], whole.of_label[2]),)


def test_a_part_that_outgrows_the_rest_and_rejoins_it_takes_its_identity() -> None:
    state = track_identities(None, *scene((20, 10, 40, 20, 10)))
    whole = state.of_label[2]
    state = track_identities(state, *scene((20, 10, 30, 20, 10), (50, 10, 10, 20, 10)))
    part = state.of_label[3]
    assert Event("split", part, whole) in state.events
    # What hides the border between them moves on.
    for left in (46, 40, 34, 30):
        state = track_identities(state, *scene((20, 10, left - 20, 20, 10), (left, 10, 60 - left, 20, 10)))
        assert (state.of_label[2], state.of_label[3]) == (whole, part)
    joined = track_identities(state, *scene((20, 10, 40, 20, 10)))
    assert joined.of_label[2] == whole
    assert joined.events == (Event("merge", part, whole),)


def test_parts_of_parts_rejoin_the_first_of_all() -> None:
    state = track_identities(None, *scene((20, 10, 40, 20, 10)))
    whole = state.of_label[2]
    for left in (50, 44, 38, 32):
        state = track_identities(state, *scene((20, 10, left - 20, 20, 10), (left, 10, 60 - left, 20, 10)))
    part = state.of_label[3]
    # The part is cut, too, and most of it becomes a part of the part.
    for left in (52, 48, 44, 40, 36):
        middle, right = (32, 10, left - 32, 20, 10), (left, 10, 60 - left, 20, 10)
        state = track_identities(state, *scene((20, 10, 12, 20, 10), middle, right))
    smallest = state.of_label[4]
    assert (state.of_label[2], state.of_label[3]) == (whole, part)
    assert smallest not in (whole, part)
    joined = track_identities(state, *scene((20, 10, 40, 20, 10)))
    assert joined.of_label[2] == whole
    assert {*joined.events} == {Event("merge", part, whole), Event("merge", smallest, whole)}


def test_a_part_of_a_forgotten_part_still_rejoins_the_whole() -> None:
    state = track_identities(None, *scene((10, 10, 60, 20, 10)))
    whole = state.of_label[2]
    state = track_identities(state, *scene((10, 10, 30, 20, 10), (40, 10, 30, 20, 10)))
    part = state.of_label[3]
    state = track_identities(state, *scene((10, 10, 30, 20, 10), (40, 10, 18, 20, 10), (58, 10, 12, 20, 10)))
    small = state.of_label[4]
    assert len({whole, part, small}) == 3
    # The middle is not seen for longer than it is remembered.
    for _ in range(40):
        state = track_identities(state, *scene((10, 10, 20, 20, 10), (58, 10, 12, 20, 10)))
    assert part not in state.appearances
    assert (state.of_label[2], state.of_label[3]) == (whole, small)
    for left in (50, 40, 30, 24, 20):
        state = track_identities(state, *scene((10, 10, left - 10, 20, 10), (left, 10, 70 - left, 20, 10)))
    assert (state.of_label[2], state.of_label[3]) == (whole, small)
    assert track_identities(state, *scene((10, 10, 60, 20, 10))).of_label[2] == whole


def test_what_remained_visible_of_a_segment_is_that_segment_when_all_of_it_is_seen_again() -> None:
    state = track_identities(None, *scene((10, 10, 60, 20, 10)))
    whole = state.of_label[2]
    # Something passes before it from right to left, and hides the larger part in the end.
    for left in range(38, 4, -3):
        hand, right = (left, 5, 30, 40, 240), (left + 30, 10, 40 - left, 20, 10)
        parts = [(10, 10, left - 10, 20, 10)] if left > 10 else []
        state = track_identities(state, *scene(*parts, hand, right))
    part = state.of_label[3]
    assert part != whole
    again = track_identities(state, *scene((10, 10, 60, 20, 10)))
    assert again.of_label[2] == whole
    assert {Event("back", whole), Event("merge", part, whole)} <= {*again.events}


def test_a_piece_that_comes_back_far_from_the_middle_is_known_when_most_of_it_is_back() -> None:
    state = track_identities(None, *scene((5, 10, 70, 20, 10)))
    whole = state.of_label[2]
    state = track_identities(state, *scene())
    state = track_identities(state, *scene((67, 10, 8, 20, 10)))
    # Too far from where it was last to be it for sure.
    assert state.of_label[2] != whole
    for left in (50, 30, 12):
        state = track_identities(state, *scene((left, 10, 75 - left, 20, 10)))
    assert state.of_label[2] == whole


def test_what_was_seen_beside_a_lost_segment_is_not_it_where_that_was() -> None:
    state = track_identities(None, *scene((10, 10, 12, 20, 100), (30, 10, 12, 20, 100)))
    gone, other = state.of_label[2], state.of_label[3]
    for left in (27, 24, 21, 18, 15, 12, 10):
        state = track_identities(state, *scene((left, 10, 12, 20, 100)))
        assert state.of_label[2] == other
    assert gone in state.appearances


def test_of_two_that_were_never_one_the_larger_keeps_its_identity() -> None:
    state = track_identities(None, *scene((20, 10, 10, 20, 10), (30, 10, 30, 20, 10)))
    small, large = state.of_label[2], state.of_label[3]
    joined = track_identities(state, *scene((20, 10, 40, 20, 10)))
    assert joined.of_label[2] == large
    assert joined.events == (Event("merge", small, large),)


def test_the_image_has_identities_and_keeps_unlabelled_pixels() -> None:
    labels, cloud = scene((10, 10, 20, 20, 10))
    labels[:5] = 0
    found = track_identities(None, labels, cloud)
    image = found.image(labels)
    assert (image[:5] == 0).all()
    assert image[15, 15] == found.of_label[2]


def test_a_frame_without_segments_has_no_identities_and_forgets_none() -> None:
    first = track_identities(None, *scene((10, 10, 20, 20, 10)))
    _, cloud = scene()
    state, lost = first, []
    for _ in range(200):
        state = track_identities(state, np.zeros(SHAPE, np.uint16), cloud)
        assert state.of_label == {}
        lost += [event.identity for event in state.events if event.kind == "lost"]
    assert sorted(lost) == sorted(first.of_label.values())
    again = track_identities(state, *scene((10, 10, 20, 20, 10)))
    assert again.of_label == first.of_label


def test_identities_are_reused_when_sixteen_bits_run_out() -> None:
    labels, cloud = scene((10, 10, 20, 20, 10))
    full = Identities({}, np.zeros((60, 80), np.uint16), {}, (), 65_535)
    found = track_identities(full, labels, cloud)
    assert sorted(found.of_label.values()) == [1, 65_535]


def test_a_sliver_between_the_pixels_of_the_grid_has_an_identity_too() -> None:
    labels = np.ones((480, 640), np.uint16)
    labels[101, 201:230] = 2
    points = np.ones((480, 640, 3), np.float32)
    cloud = PointMap(points, np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.bool_))
    found = track_identities(None, labels, cloud)
    assert set(found.of_label) == {1, 2}
    assert found.image(labels)[101, 210] != found.image(labels)[0, 0]
    # It comes and goes without a pixel of the grid: it is of no other segment.
    without = track_identities(found, np.ones((480, 640), np.uint16), cloud)
    assert without.events == (Event("lost", found.of_label[2]),)
    blue = PointMap(points, np.full((480, 640, 3), (0, 0, 255), np.uint8), cloud.valid)
    again = track_identities(without, labels, blue)
    assert again.events == (Event("new", again.of_label[2]),)


@given(st.integers(0, 2**32 - 1))
def test_no_two_segments_of_a_frame_share_an_identity(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, cloud = scene()
    state: Identities | None = None
    for _ in range(4):
        labels = np.repeat(np.repeat(rng.integers(0, 6, (6, 8)), 10, 0), 10, 1).astype(np.uint16)
        with mock.patch.object(identity, "_REMEMBERED", 2):
            state = track_identities(state, labels, cloud)
        assert len(set(state.of_label.values())) == len(state.of_label)
        assert set(state.of_label) == set(np.unique(labels[labels > 0]))


def test_what_comes_back_bit_by_bit_is_known_by_what_was_seen_of_it_at_its_best() -> None:
    whole = (50, 20, 16, 20, 240)
    first = state = track_identities(None, *scene(whole))
    for width in (12, 8, 4):
        state = track_identities(state, *scene((50, 20, width, 20, 240)))
    state = track_identities(state, *scene())
    back = track_identities(state, *scene((52, 20, 5, 20, 240)))
    assert back.of_label[2] == first.of_label[2]


def test_identities_go_along_with_what_is_known_of_the_motion() -> None:
    first = track_identities(None, *scene((10, 10, 10, 10, 240)))
    labels, cloud = scene((40, 30, 10, 10, 10))
    alone = track_identities(first, labels, cloud)
    assert alone.of_label[2] != first.of_label[2]
    followed = track_identities(first, labels, cloud, before=labels)
    assert followed.of_label == first.of_label
    assert followed.events == ()


def test_appearances_are_means_over_every_few_rows_and_columns() -> None:
    labels, cloud = scene((10, 10, 20, 20, 10), (50, 20, 15, 20, 240))
    color = np.random.default_rng(0).integers(0, 200, (*SHAPE, 3)).astype(np.uint8)
    color[labels == 2, 0] += 50
    found = appearances_of(labels, [1, 2, 3, 9], PointMap(cloud.points_m, color, cloud.colored), 3)
    assert set(found) == {1, 2, 3}
    for label, each in found.items():
        there = labels[::3, ::3] == label
        assert each.pixels == np.count_nonzero(there)
        assert each.center_m == pytest.approx(
            cloud.points_m[::3, ::3][there].mean(axis=0), rel=1e-5, abs=1e-6
        )
        mean = np.rint(color[::3, ::3][there].mean(axis=0)).astype(np.float32) / 255.0
        assert each.color_lab == pytest.approx(
            cv2.cvtColor(mean.reshape(1, 1, 3), cv2.COLOR_RGB2LAB)[0, 0], abs=0.2
        )


def test_a_segment_that_is_hiding_keeps_the_color_and_shrinks_slowly():
    before = Appearance((0.0, 0.0, 1.0), (50.0, 1.0, 2.0), 1000, 1, (0.02, 0.02, 0.02))
    now = Appearance((0.1, 0.0, 1.0), (40.0, 3.0, 4.0), 400)
    after = updated(before, now)
    assert np.array_equal(after.center_m, now.center_m)
    assert np.array_equal(after.color_lab, before.color_lab)
    # Half of the motion is that of the last frame, or of one of two frames.
    assert np.allclose(after.motion_m, [0.035, 0.01, 0.01])
    assert (after.pixels, after.unseen) == (970, 0)
    seen_whole = updated(before, replace(now, pixels=980))
    assert np.array_equal(seen_whole.color_lab, now.color_lab)
    assert (seen_whole.pixels, seen_whole.unseen) == (980, 0)
    assert np.array_equal(seen_whole.motion_m, after.motion_m)
