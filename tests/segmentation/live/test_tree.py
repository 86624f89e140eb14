"""The live tree: what stays, what comes and goes, and what makes it begin anew."""

from dataclasses import replace

import numpy as np
import pytest

from nurbseg.common.settings import updated
from nurbseg.segmentation.config import ExtendedConfig, SegmentationConfig
from nurbseg.segmentation.live.tree import Budget, LiveTree, supports_live_tree
from nurbseg.segmentation.methods import segment
from nurbseg.segmentation.points.registration import PointMap
from nurbseg.segmentation.segments import SegmentationTree

SHAPE = (120, 160)
FOCAL = 130.0
CONFIG = SegmentationConfig(method="nurbseg", samples=60, extended=ExtendedConfig(level="surfaces"))
Box = tuple[int, int, int, int]


def scene(*boxes: Box, noise: int | None = 0, wall_m: float = 1.6, shift: int = 0) -> PointMap:
    """Boxes (left, top, width, height) 1 m away, before a tilted wall; a pattern tells the motion."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    depth = wall_m + 0.001 * (columns + shift)
    pattern = 110 + 50 * np.sin((columns + shift) / 5.0) * np.cos(rows / 4.0)
    color = np.repeat(pattern[..., np.newaxis], 3, axis=2)
    for left, top, width, height in boxes:
        left -= shift
        inside = (columns >= left) & (columns < left + width) & (rows >= top) & (rows < top + height)
        depth[inside] = 1.0
        color[inside] = (200, 60, 40)
        color[inside, 1] += 40 * np.sin((columns - left) / 3.0)[inside]
    if noise is not None:
        depth = 1 / (1 / depth + 1e-3 * np.random.default_rng(noise).standard_normal(SHAPE))
    points = np.dstack([(columns - 79.5) / FOCAL * depth, (rows - 59.5) / FOCAL * depth, depth])
    return PointMap(
        points.astype(np.float32), color.clip(0, 255).astype(np.uint8), np.ones(SHAPE, dtype=np.bool_)
    )


BOX = (40, 40, 40, 40)


def inside(box: Box, shift: int = 0) -> tuple[slice, slice]:
    """The pixels of a box but for its rim."""
    left, top, width, height = box
    return slice(top + 3, top + height - 3), slice(left - shift + 3, left - shift + width - 3)


def only(values: np.ndarray) -> int:
    """The one value of an image."""
    (value,) = np.unique(values)
    return int(value)


@pytest.fixture
def tree() -> LiveTree:
    """A live tree that has seen a wall and a box."""
    live = LiveTree(CONFIG)
    live.segment(scene(BOX))
    assert live.report.reset == "first frame"
    return live


def same(found: SegmentationTree, alone: SegmentationTree) -> None:
    """Hold a tree against that of the frame alone, in all that is known of both."""
    assert np.array_equal(found.labels("surfaces"), alone.labels("surfaces"))
    assert np.array_equal(found.labels("objects"), alone.labels("objects"))
    assert len(found.segments) == len(alone.segments)
    for one, other in zip(found.segments, alone.segments, strict=True):
        of_one, of_other = ((each.name, each.division, each.stop, each.trial) for each in (one, other))
        assert of_one == of_other
        assert (one.cuts_above, one.measured, one.judged) == (other.cuts_above, None, None)
        assert np.array_equal(one.pixels, other.pixels)
        assert dict(one.fit.values) == dict(other.fit.values)
        assert np.array_equal(one.fit.residuals_m, other.fit.residuals_m)
    assert [each.leaves for each in found.objects] == [each.leaves for each in alone.objects]
    assert [contact.merged for contact in found.contacts] == [contact.merged for contact in alone.contacts]


@pytest.mark.parametrize("extended", [{}, {"protrusion_min": 0.0}, {"fold_surfaces": False}])
def test_the_first_frame_is_that_of_a_frame_alone(extended: dict[str, object]) -> None:
    config = updated(CONFIG, extended=extended)
    # Components, cuts, and rows without a point.
    whole = scene(BOX, (100, 10, 40, 60), (50, 90, 30, 25))
    points_m = whole.points_m.copy()
    points_m[80:84] = np.nan
    cloud = PointMap(points_m, whole.color, whole.colored)
    live = LiveTree(config)
    alone = segment(cloud, config)
    assert len(alone.leaves()) > 4
    same(live.segment(cloud), alone)
    # And so is that after a new start, whatever was before.
    live.segment(scene(BOX, noise=1))
    live.restart("a jump")
    same(live.segment(cloud), alone)
    assert live.report.reset == "a jump"
    live.segment(cloud)
    assert live.report.reset == ""


def test_pixels_between_those_of_the_grid_have_a_label_as_soon_as_they_have_depth() -> None:
    live, whole = LiveTree(updated(CONFIG, decimation=4, extended={"refine_borders": False})), scene(BOX)
    points_m = whole.points_m.copy()
    points_m[1::4, 2:] = np.nan
    live.segment(PointMap(points_m, whole.color, whole.colored))
    labels = live.segment(whole).labels("surfaces")
    assert live.report.reset == ""
    assert (labels > 0).all()


def test_labels_go_with_the_camera(tree: LiveTree) -> None:
    box = only(tree.segment(scene(BOX)).labels("surfaces")[inside(BOX)])
    for shift in range(2, 22, 2):
        labels = tree.segment(scene(BOX, noise=shift, shift=shift)).labels("surfaces")
        assert tree.report.reset == ""
        assert only(labels[inside(BOX, shift)]) == only(tree.labels_before[inside(BOX, shift)]) == box
        assert labels[60, 5] != box


def test_pixels_without_depth_keep_their_leaf_while_labels_change(tree: LiveTree) -> None:
    before = tree.segment(scene(BOX)).labels("surfaces")
    rows, columns = inside(BOX)
    hole = slice(rows.start + 8, rows.stop - 8), slice(columns.start + 8, columns.stop - 8)
    # What appears divides the wall, whose label is the first.
    new = (100, 30, 30, 50)
    cloud = scene(BOX, new)
    points_m = cloud.points_m.copy()
    points_m[hole] = np.nan
    now = tree.segment(PointMap(points_m, cloud.color, cloud.colored)).labels("surfaces")
    assert tree.report.reset == ""
    assert only(now[hole]) == 0
    box = int(now[rows.start, columns.start])
    assert box != only(before[hole])
    tree.segment(scene(BOX, new))
    assert only(tree.labels_before[hole]) == box


@pytest.mark.parametrize("coarser", [0, 1, 2])
def test_a_new_scene_is_segmented_on_the_grid_of_the_budget(tree: LiveTree, coarser: int) -> None:
    other = scene((10, 10, 120, 90), noise=5, wall_m=3.0)
    found = tree.segment(other, Budget(coarser=coarser))
    assert (tree.report.reset, tree.report.step) == ("new scene", 1 + coarser)
    alone = segment(other, replace(CONFIG, decimation=1 + coarser))
    assert np.array_equal(found.labels("surfaces"), alone.labels("surfaces"))
    # The tree is continued from there, on that grid and on another one.
    for following in (coarser, 0):
        again = tree.segment(other, Budget(coarser=following))
        assert (tree.report.reset, tree.report.step) == ("", 1 + following)
        assert np.mean(again.labels("surfaces") == found.labels("surfaces")) > 0.98


def test_images_of_another_size_are_segmented_from_scratch(tree: LiveTree) -> None:
    whole = scene(BOX)
    part = PointMap(
        *(np.ascontiguousarray(each[:100]) for each in (whole.points_m, whole.color, whole.colored))
    )
    assert tree.segment(part).shape == (100, 160)
    assert tree.report.reset == "new image size"


def test_a_frame_without_depth_is_survived(tree: LiveTree) -> None:
    whole = scene(BOX)
    nothing = PointMap(np.full_like(whole.points_m, np.nan), whole.color, whole.colored)
    assert not tree.segment(nothing).labels("surfaces").any()
    assert (tree.segment(whole).labels("surfaces") > 0).all()


def test_only_the_default_method_has_a_live_tree() -> None:
    assert supports_live_tree(CONFIG)
    config = replace(CONFIG, method="stag15")
    assert not supports_live_tree(config)
    with pytest.raises(ValueError, match="nurbseg"):
        LiveTree(config)
