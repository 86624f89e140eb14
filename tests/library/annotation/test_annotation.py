"""A frame's objects as a person corrects them: what each correction leaves, and takes back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nurbseg import Annotation, RGBDFrame, SegmentationConfig, segment
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import Segmenter
from nurbseg.segmentation.config import ExtendedConfig

#: Rows and columns of four plates in front of a wall, each farther from it than a gap.
PLATES = (np.s_[10:50, 12:60], np.s_[10:50, 90:140], np.s_[70:108, 12:60], np.s_[70:108, 90:140])


def frame(index: int = 0) -> RGBDFrame:
    rows, columns = np.mgrid[:120, :160]
    depth, color = np.full((120, 160), 2000, np.uint16), np.full((120, 160, 3), 90, np.uint8)
    for number, plate in enumerate(PLATES):
        depth[plate] = 1100 + 100 * number
        color[plate] = (200 - 40 * number, 60 + 30 * number, 40)
    # A slope within the first plate, which one surface explains.
    depth[PLATES[0]] += (2 * rows + columns).astype(np.uint16)[PLATES[0]]
    depth[:, :3] = 0
    return RGBDFrame.from_arrays(depth, color, 130.0, 130.0, 79.5, 59.5, index=index)


@pytest.fixture(scope="module")
def result() -> FrameResult:
    return segment(frame())


def label_at(annotation: Annotation, plate: int) -> int:
    rows, columns = PLATES[plate]
    return int(annotation.labels[(rows.start + rows.stop) // 2, (columns.start + columns.stop) // 2])


def test_what_is_merged_has_the_first_label_and_nothing_else_changes(result: FrameResult) -> None:
    annotation = Annotation(result)
    before = annotation.labels.copy()
    one, two, three = (label_at(annotation, plate) for plate in (3, 0, 1))
    # They do not touch.
    assert annotation.merge(one, two, three) == one
    expected = np.where(np.isin(before, (two, three)), one, before)
    assert np.array_equal(annotation.labels, expected)
    assert set(annotation.objects) == set(np.unique(before).tolist()) - {0, two, three}
    measured = {each.label: each.pixels.size for each in annotation.result.objects}
    assert measured == {label: int((expected == label).sum()) for label in annotation.objects}
    assert np.array_equal(result.labels("objects"), before)


def test_a_split_takes_the_last_merge_apart_then_the_one_before(result: FrameResult) -> None:
    annotation = Annotation(result)
    before = annotation.labels.copy()
    one, two, three = (label_at(annotation, plate) for plate in (0, 1, 2))
    annotation.merge(one, two)
    annotation.merge(three, one)
    annotation.split(three)
    # The two that were merged first are still one.
    assert label_at(annotation, 0) == label_at(annotation, 1) != label_at(annotation, 2)
    annotation.split(label_at(annotation, 0))
    assert len({label_at(annotation, plate) for plate in range(3)}) == 3
    for label in np.unique(before):
        assert len(np.unique(annotation.labels[before == label])) == 1
    assert annotation.corrections == 4


def test_the_segmentations_own_merges_are_undone_from_the_last_one() -> None:
    everything = SegmentationConfig(extended=ExtendedConfig(log_odds_min=-1e6))
    annotation = Annotation(segment(frame(), everything))
    (only,) = annotation.objects
    tree = annotation.result.tree
    last = [merge for merge in tree.merges if merge.merged][-1]
    annotation.split(only)
    labels, surfaces = annotation.labels, tree.labels("surfaces")
    numbers = {leaf.name: n for n, leaf in enumerate(tree.leaves(), start=1)}
    apart = [labels[surfaces == numbers[name]][0] for name in (last.first, last.second)]
    assert sorted(apart) == list(annotation.objects) == [1, 2]
    # The larger part keeps its number.
    assert (labels == only).sum() >= (labels > 0).sum() / 2


def test_an_object_is_taken_apart_into_its_surfaces() -> None:
    everything = SegmentationConfig(extended=ExtendedConfig(log_odds_min=-1e6))
    annotation = Annotation(segment(frame(), everything))
    surfaces = annotation.result.labels("surfaces")
    numbers, sizes = np.unique(surfaces[surfaces > 0], return_counts=True)
    labels = annotation.take_apart(1)
    assert labels == annotation.objects == tuple(range(1, numbers.size + 1))
    by_size = numbers[np.argsort(-sizes, kind="stable")]
    for label, number in zip(labels, by_size, strict=True):
        assert np.array_equal(annotation.labels == label, surfaces == number)
    with pytest.raises(ValueError, match="object 1 is one surface; it can only be split in two"):
        annotation.take_apart(1)
    annotation.undo()
    assert annotation.objects == (1,)


def test_a_single_surface_is_cut_in_two_connected_parts(result: FrameResult) -> None:
    annotation = Annotation(result)
    before, plate = annotation.labels.copy(), label_at(annotation, 0)
    kept, new = annotation.split(plate)
    labels = annotation.labels
    assert kept == plate
    assert new not in before
    assert np.array_equal(np.isin(labels, (kept, new)), before == plate)
    assert (labels == kept).sum() >= (labels == new).sum() > 0
    assert np.array_equal(labels[before != plate], before[before != plate])
    tree = annotation.result.tree
    for each in tree.segments:
        below = [leaf.pixels for leaf in tree.leaves() if leaf.name.startswith(each.name)]
        assert np.array_equal(each.pixels, np.concatenate(below))
    assert all(each.rms_m is not None for each in annotation.result.objects)


def test_splits_go_on_until_a_surface_is_too_small(result: FrameResult) -> None:
    annotation = Annotation(result)
    covered, plate = annotation.labels > 0, label_at(annotation, 0)
    while annotation.corrections < 100:
        try:
            annotation.split(plate)
        except ValueError as err:
            assert str(err) == f"object {plate} is one surface, which is too small to be cut"
            break
    assert 5 < annotation.corrections < 100
    assert np.array_equal(annotation.labels > 0, covered)


def test_the_least_size_of_a_segment_does_not_bind_a_person() -> None:
    # 1250 pixels of this image: more than half of a plate.
    annotation = Annotation(
        segment(frame(), SegmentationConfig(extended=ExtendedConfig(piece_pixels_min=20_000)))
    )
    annotation.split(label_at(annotation, 0))
    assert annotation.corrections == 1


def test_each_correction_can_be_undone_to_the_beginning(result: FrameResult) -> None:
    annotation = Annotation(result)
    before = [annotation.labels.copy()]
    for plate in (0, 1, 2):
        annotation.split(label_at(annotation, plate))
        before.append(annotation.labels.copy())
        annotation.merge(label_at(annotation, plate), label_at(annotation, 3))
        before.append(annotation.labels.copy())
    while annotation.corrections:
        assert np.array_equal(annotation.labels, before.pop())
        annotation.undo()
    assert np.array_equal(annotation.labels, before.pop())
    assert before == []
    assert annotation.result is result
    with pytest.raises(ValueError, match="nothing was corrected"):
        annotation.undo()


@pytest.mark.parametrize(
    ("labels", "said"),
    [
        ((), "got none"),
        ((1,), "got 1"),
        ((1, 1), "got 1 1"),
        ((1, 99), "no object 99 in this frame, but 1, 2"),
    ],
)
def test_what_cannot_be_merged_is_said_and_changes_nothing(
    result: FrameResult, labels: tuple[int, ...], said: str
) -> None:
    annotation = Annotation(result)
    with pytest.raises(ValueError, match=said):
        annotation.merge(*labels)
    with pytest.raises(ValueError, match="no object 0 in this frame"):
        annotation.split(0)
    assert annotation.corrections == 0


@pytest.mark.parametrize(
    "config",
    [SegmentationConfig(method="stag15"), SegmentationConfig(extended=ExtendedConfig(merge_surfaces=False))],
)
def test_where_there_are_no_objects_surfaces_are_corrected(config: SegmentationConfig) -> None:
    result = segment(frame(), config)
    assert not result.tree.objects
    annotation = Annotation(result)
    before = result.labels("surfaces")
    assert set(annotation.objects) == set(np.unique(before)) - {0}
    one, other = annotation.objects[:2]
    annotation.merge(one, other)
    assert np.array_equal(annotation.labels, np.where(before == other, one, before))
    annotation.split(one)
    assert np.array_equal(np.unique(annotation.labels), np.unique(before))


def test_labels_of_a_sequence_stay_those_of_the_frames_before() -> None:
    segmenter = Segmenter()
    segmenter.process(frame())
    second = frame(1)
    # The last plate is taken away, so that labels are no longer 1, 2, 3 ...
    depth_mm = second.depth_mm.copy()
    depth_mm[PLATES[1]] = 2000
    result = segmenter.process(replace(second, depth_mm=depth_mm))
    annotation = Annotation(result)
    before = result.labels("objects")
    assert set(annotation.objects) == set(np.unique(before)) - {0}
    plates = [label_at(annotation, plate) for plate in (2, 3)]
    annotation.merge(*plates)
    expected = np.where(before == plates[1], plates[0], before)
    assert np.array_equal(annotation.labels, expected)
    annotation.split(label_at(annotation, 0))
    surfaces, was = annotation.result.labels("surfaces"), result.labels("surfaces")
    elsewhere = before != label_at(annotation, 0)
    assert np.array_equal(surfaces[elsewhere], was[elsewhere])


def test_a_corrected_frame_is_drawn_and_may_be_corrected_again(result: FrameResult) -> None:
    annotation = Annotation(result)
    annotation.merge(*(label_at(annotation, plate) for plate in (0, 1)))
    assert annotation._repr_png_() != result._repr_png_()
    again = Annotation(annotation.result)
    assert np.array_equal(again.labels, annotation.labels)
    assert repr(again) == f"Annotation(frame 0, {len(again.objects)} objects, 0 corrections)"
    again.split(label_at(again, 0))
    assert label_at(again, 0) != label_at(again, 1)
