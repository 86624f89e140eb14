"""What a frame no longer supports is undone: cuts by their ratio, protrusions by what is in front."""

import numpy as np
import pytest
from plates import CONFIG, PLATE_PER_M, PLATES, Box, plates, rising

from nurbseg.common.settings import updated
from nurbseg.segmentation.live.tree import UNLIMITED, Budget, LiveTree
from nurbseg.segmentation.segments import SegmentationTree
from nurbseg.segmentation.vocabulary import Division, StopReason

CUTS = updated(CONFIG, extended={"protrusion_min": 0.0})
#: A plate of all rows.
DOOR: Box = (40, 0, 40, 120)


def test_a_door_that_opens_keeps_its_cut_and_loses_it_some_frames_after_it_is_flush() -> None:
    live, counts = LiveTree(CUTS), []
    for frame in range(40):
        nearer = PLATE_PER_M if frame < 12 else 0.0
        tree = live.segment(plates(DOOR, frame=frame, nearer_per_m=(nearer,)), UNLIMITED, frame=frame)
        assert (live.report.reset == "") == (frame > 0)
        counts.append(len(tree.leaves()))
        if 4 <= frame < 12:
            # No leaf is on the door and on the wall.
            labels = tree.labels("surfaces")
            assert not {*labels[:, 45:75].flat} & {*labels[:, 5:35].flat, *labels[:, 85:].flat}
            for cut in (each for each in tree.segments if each.division is Division.CUT):
                assert cut.ratio is not None
                assert cut.ratio < CUTS.ratio_max
    # One ratio of about 1 does not undo a cut, their average does.
    assert counts[11] > 1
    assert counts[13] > 1
    assert counts[-1] == 1
    assert tree.root.stop is StopReason.NOISE
    assert (tree.root.division, tree.root.trial, tree.root.cut) == (None, None, None)
    assert tree.root.fit.surface is not None


def test_a_cut_is_judged_by_one_surface_for_all_and_those_of_the_leaves_below() -> None:
    live = LiveTree(CUTS)
    for frame in range(24):
        tree = live.segment(rising(frame), UNLIMITED, frame=frame)
    cuts = [each for each in tree.segments if each.division is Division.CUT and each.judged is None]
    assert len(cuts) > 1
    for cut in cuts:
        assert cut.trial is not None
        leaves = [leaf for leaf in tree.leaves() if leaf.name.startswith(cut.name)]
        sizes = [leaf.fit.pixels.size for leaf in leaves]
        assert [points for _, points in cut.trial.parts] == sizes
        assert cut.trial.points == sum(sizes) == cut.fit.pixels.size
        for (value, _), leaf in zip(cut.trial.parts, leaves, strict=True):
            # What noise leaves counts at least.
            assert value == pytest.approx(max(leaf.fit.values["mse"], leaf.fit.floor), rel=1e-9)


def labels_in(tree: SegmentationTree, plate: tuple[int, int, int, int]) -> tuple[int, int]:
    """Most frequent labels of a plate's inner pixels, and of the wall above it."""
    left, top, width, height = plate
    inner = tree.labels()[top + 5 : top + height - 5, left + 5 : left + width - 5]
    around = tree.labels()[top - 10 : top - 4, left : left + width]
    return int(np.bincount(inner.ravel()).argmax()), int(np.bincount(around.ravel()).argmax())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("protrusion_min", [0.0, 2.5])
def test_plates_have_leaves_until_they_are_pressed_flat(protrusion_min: float, seed: int) -> None:
    live = LiveTree(updated(CONFIG, seed=seed, extended={"protrusion_min": protrusion_min}))
    for frame in range(40):
        tree = live.segment(rising(min(frame, 20), frame))
        assert (live.report.reset == "") == (frame > 0)
    for plate in PLATES:
        inner, around = labels_in(tree, plate)
        assert inner != around
    # What is just at the limit is given up in the end.
    for frame in range(40):
        nearer = 4 * (PLATE_PER_M * max(0.0, 1 - 0.2 * frame),)
        tree = live.segment(plates(*PLATES, frame=frame, nearer_per_m=nearer))
        assert live.report.reset == ""
    assert len(tree.segments) == 1


def test_each_of_several_protrusions_is_given_back_by_itself() -> None:
    live = LiveTree(CONFIG)
    both = PLATES[0], PLATES[3]
    live.segment(plates(*both, frame=0, nearer_per_m=(0.0, 0.0)))
    for frame in range(1, 8):
        near = min(0.004 * frame, PLATE_PER_M)
        tree = live.segment(plates(*both, frame=frame, nearer_per_m=(near, near)))
    assert all(one != other for one, other in (labels_in(tree, plate) for plate in both))
    for frame in range(8):
        near = max(0.0, PLATE_PER_M - 0.004 * frame)
        tree = live.segment(plates(*both, frame=frame, nearer_per_m=(near, PLATE_PER_M)))
    first, other = (labels_in(tree, plate) for plate in both)
    assert first[0] == first[1]
    assert other[0] != other[1]


def test_nothing_is_undone_without_room_but_in_turn() -> None:
    live = LiveTree(CUTS)
    for frame in range(24):
        tree = live.segment(rising(frame), Budget(judged_pixels=0))
    cuts = sum(segment.division is Division.CUT for segment in tree.segments)
    assert cuts > 2
    for frame in range(12 + 4 * cuts):
        nearer = 4 * (PLATE_PER_M * max(0.0, 1 - 0.2 * frame),)
        tree = live.segment(plates(*PLATES, frame=frame, nearer_per_m=nearer), Budget(judged_pixels=0))
        assert live.report.judged <= 1
    assert len(tree.segments) == 1
