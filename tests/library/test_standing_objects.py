"""Boxes that stand on a table: upright, tied from frame to frame, with the pose and size of the truth."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import ModuleType

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from standing import BOXES, StandingBox, looking, seen

from nurbseg.common.frame import RGBDFrame
from nurbseg.library.boxes.completion import standing
from nurbseg.library.boxes.planar_motion import world_from_support
from nurbseg.library.boxes.support import Support, find_support
from nurbseg.library.objects import MeasuredObject
from nurbseg.library.palette import label_color
from nurbseg.library.result import FrameResult
from nurbseg.library.segmenter import Segmenter, process_frame
from nurbseg.segmentation.config import SegmentationConfig

CAMERA = looking((0.0, -0.9, 0.7), (0.0, 0.1, 0.0))


def of_box(result: FrameResult, box: StandingBox) -> MeasuredObject:
    """Return the object that has a box's color."""
    large = [each for each in result.objects if each.pixels.size > 500]
    return min(large, key=lambda each: float(np.abs(each.mean_color - box.color).sum()))


def errors(
    each: MeasuredObject, box: StandingBox, world_from_camera: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Return the errors of center and size, meters, and yaw, degrees."""
    camera_from_box = np.linalg.inv(world_from_camera) @ box.world_from_box()
    turn = each.box.axes @ camera_from_box[:3, :3]
    angle = np.degrees(np.arctan2(turn[0, 1], turn[0, 0]))
    quarter = round(angle / 90)
    size = each.box.size_m[[1, 0, 2]] if quarter % 2 else each.box.size_m
    center = float(np.linalg.norm(each.box.center_m - camera_from_box[:3, 3]))
    return center, float(np.abs(size - box.size).max()), abs(angle - 90 * quarter)


def test_a_frame_alone_has_upright_boxes_that_reach_the_table() -> None:
    result = process_frame(seen(CAMERA))
    for box in BOXES:
        each = of_box(result, box)
        center_m, size_m, yaw = errors(each, box, CAMERA)
        assert center_m < 0.01 and size_m < 0.015 and yaw < 2.0
        assert each.support is not None and each.support.found_by == "largest"
        assert each.support.camera_height_m == pytest.approx(0.7, abs=0.003)
        np.testing.assert_allclose(each.box.axes[2], CAMERA[:3, :3].T @ [0, 0, 1], atol=0.005)
        assert each.support_from_object is not None
        assert each.support_from_object[2, 3] == pytest.approx(box.size[2] / 2, abs=0.008)
        np.testing.assert_allclose(
            np.linalg.inv(each.support.support_from_camera) @ each.support_from_object,
            each.camera_from_object,
            atol=1e-9,
        )
        assert each.visible.size_m[2] <= each.box.size_m[2] + 1e-9
        assert each.is_sure and 0.2 < each.rms_over_noise < 4 and each.hidden_share < 0.1


def mixed_with_what_is_behind(seed: int) -> tuple[RGBDFrame, NDArray[np.bool_]]:
    """Return a frame in which pixels beside edges are anywhere up to nine tenths of the way behind them."""
    frame = seen(CAMERA)
    near = cv2.erode(frame.depth_mm, np.ones((3, 3), dtype=np.uint8))
    rim = frame.depth_mm > near + 60
    share = np.random.default_rng(seed).uniform(0.0, 0.9, rim.shape)
    depth_mm = np.where(rim, near + share * (frame.depth_mm - near), frame.depth_mm).astype(np.uint16)
    return replace(frame, depth_mm=depth_mm), rim


@pytest.mark.parametrize("seed", range(3))
def test_pixels_mixed_with_what_is_behind_do_not_make_a_box_longer(seed: int) -> None:
    frame, rim = mixed_with_what_is_behind(seed)
    assert np.count_nonzero(rim) > 2000
    result = process_frame(frame)
    for box in BOXES:
        center_m, size_m, yaw = errors(of_box(result, box), box, CAMERA)
        assert center_m < 0.015 and size_m < 0.03 and yaw < 4.0


def test_points_mixed_with_what_is_behind_do_not_make_an_object_unsure() -> None:
    result = process_frame(mixed_with_what_is_behind(0)[0])
    for box in BOXES:
        each = of_box(result, box)
        assert each.is_sure
        residuals_m = np.concatenate([result.tree[name].fit.residuals_m for name in each.leaves])
        nearest = np.sort(residuals_m)[: int(np.ceil(0.95 * residuals_m.size))]
        assert each.fit_error_m == pytest.approx(np.linalg.norm(nearest) / nearest.size**0.5)
    # Here they count.
    assert max(of_box(result, box).rms_m / of_box(result, box).noise_m for box in BOXES) > 5


def test_what_its_surfaces_do_not_follow_is_not_sure() -> None:
    result = process_frame(seen(CAMERA))
    each = of_box(result, BOXES[0])
    leaf = max((result.tree[name] for name in each.leaves), key=lambda leaf: leaf.pixels.size)
    for share, is_sure in ((0.04, True), (0.2, False)):
        residuals_m = leaf.fit.residuals_m.copy()
        residuals_m[: round(share * residuals_m.size)] = 0.05
        far = replace(leaf, fit=replace(leaf.fit, residuals_m=residuals_m))
        tree = replace(result.tree, segments=tuple(far if s is leaf else s for s in result.tree.segments))
        assert replace(each, leaves=(leaf.name,), tree=tree).is_sure == is_sure


def test_what_is_tiny_is_not_sure() -> None:
    result = process_frame(seen(CAMERA))
    each = of_box(result, BOXES[0])
    (leaf,) = (segment for segment in result.tree.segments if segment.name == each.leaves[0])
    least = 100 * result.tree.shape[0] * result.tree.shape[1] // (640 * 480)
    for pixels, is_sure in ((least, True), (least - 1, False)):
        cut = [replace(s, pixels=s.pixels[:pixels]) if s is leaf else s for s in result.tree.segments]
        tree = replace(result.tree, segments=tuple(cut))
        assert replace(each, leaves=(leaf.name,), tree=tree).is_sure == is_sure


def test_the_picture_has_outlines_and_numbers_of_objects() -> None:
    result = process_frame(seen(CAMERA))
    picture, labels = result.picture(), result.labels("objects")
    changed = (picture != result.cloud.color).any(axis=2)
    for box in BOXES:
        each = of_box(result, box)
        own = (labels == each.label).astype(np.uint8)
        rim = (own > 0) & (cv2.erode(own, np.ones((3, 3), np.uint8)) == 0)
        drawn = (picture == label_color(each.label)).all(axis=2)
        # Numbers are drawn over outlines.
        assert (drawn[rim]).mean() > 0.7
        assert not drawn[own == 0].any()
        assert changed[own > 0].mean() < 0.6
    assert cv2.imdecode(np.frombuffer(result._repr_png_(), np.uint8), cv2.IMREAD_COLOR).shape == picture.shape


def test_a_notebook_shows_the_picture_and_nothing_else_can(monkeypatch: pytest.MonkeyPatch) -> None:
    result = process_frame(seen(CAMERA))
    shown: list[object] = []
    module = ModuleType("IPython.display")
    module.__dict__["display"] = shown.append
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    result.show()
    assert shown == [result]
    monkeypatch.setitem(sys.modules, "IPython.display", None)
    with pytest.raises(RuntimeError, match=r"picture\(\) returns the image"):
        result.show()


def test_gravity_says_what_the_support_is() -> None:
    wall = StandingBox(0.0, 0.6, (3.0, 0.1, 2.0), 0.0, (90, 90, 90))
    high = looking((0.0, -0.9, 0.5), (0.0, 0.6, 0.2))
    frame = seen(high, (wall, BOXES[1]))
    down = high[:3, :3].T @ [0.0, 0.0, -1.0]
    each = process_frame(replace(frame, gravity=down)).objects[0]
    assert each.support is not None and each.support.found_by == "gravity"
    assert each.support.camera_height_m == pytest.approx(0.5, abs=0.005)
    # Gravity along the camera's x axis: nothing level is there to stand on.
    assert process_frame(replace(frame, gravity=np.array([1.0, 0.0, 0.0]))).objects[0].support is None


def turned(frame: RGBDFrame, quarters: int) -> RGBDFrame:
    """Return a frame as a camera takes it that is turned clockwise by so many quarters."""
    camera = frame.calibration.depth
    depth, color = (
        np.ascontiguousarray(np.rot90(image, quarters)) for image in (frame.depth_mm, frame.color)
    )
    center = camera.cx, camera.cy
    for _ in range(quarters):
        center = center[1], (camera.width if _ % 2 == 0 else camera.height) - 1 - center[0]
    return RGBDFrame.from_arrays(depth, color, camera.fx, camera.fy, *center)


@pytest.mark.parametrize("down_m", [0.2, -0.6])
def test_boxes_of_a_turned_camera_are_right_where_up_is_stated_and_else_not_sure(down_m: float) -> None:
    wall = StandingBox(0.0, 0.6, (3.0, 0.1, 1.2), 0.0, (90, 90, 90))
    upright = seen(looking((0.0, -0.9, 0.5), (0.0, 0.6, down_m)), (wall, *BOXES[:2]))
    sides = ("top", "left", "bottom", "right")
    expected = {box: of_box(process_frame(upright), box) for box in BOXES[:2]}
    for quarters in (0, 1, 2, 3):
        frame = turned(upright, quarters)
        extended = replace(SegmentationConfig().extended, up=sides[quarters])
        stated = process_frame(frame, SegmentationConfig(extended=extended))
        alone = process_frame(frame)
        for box, each in expected.items():
            assert each.is_sure
            np.testing.assert_allclose(of_box(stated, box).box.size_m, each.box.size_m, atol=0.012)
            assert of_box(stated, box).is_sure
            assert of_box(alone, box).is_sure == (quarters == 0)


def path(index: int) -> NDArray[np.float64]:
    """A camera that goes about the table."""
    turn = 0.25 * np.sin(index / 12)
    return looking((0.9 * np.sin(turn), -0.9 * np.cos(turn), 0.7), (0.0, 0.1, 0.0))


def test_boxes_of_things_at_rest_stay_where_they_are_while_the_camera_moves() -> None:
    segmenter = Segmenter()
    before: dict[int, NDArray[np.float64]] = {}
    for index in range(40):
        result = segmenter.process(seen(path(index), index=index))
        for each in result.objects:
            if each.label in before:
                cosine = (np.trace(each.box.axes @ before[each.label].T) - 1) / 2
                assert cosine > np.cos(np.radians(10))
            before[each.label] = each.box.axes
        if index > 5:
            for box in BOXES:
                each = of_box(result, box)
                center_m, size_m, yaw = errors(each, box, path(index))
                assert center_m < 0.015 and size_m < 0.02 and yaw < 3.0, (index, box, center_m, size_m, yaw)
                # The camera moves at up to 0.6 m/s.
                assert index < 20 or np.linalg.norm(each.track.velocity_m_s) < 0.05
                assert each.track.seen_s == pytest.approx(index / 30, abs=0.001)


def test_a_thing_that_is_pushed_has_a_velocity_and_the_others_have_none() -> None:
    segmenter = Segmenter()
    for index in range(30):
        pushed = replace(BOXES[1], x=BOXES[1].x + 0.15 * index / 30)
        boxes = (BOXES[0], pushed, BOXES[2])
        result = segmenter.process(seen(CAMERA, boxes, index=index))
        assert result.objects
    velocity = CAMERA[:3, :3] @ of_box(result, pushed).track.velocity_m_s
    np.testing.assert_allclose(velocity, [0.15, 0.0, 0.0], atol=0.05)
    for box in (BOXES[0], BOXES[2]):
        assert np.linalg.norm(of_box(result, box).track.velocity_m_s) < 0.04
    assert errors(of_box(result, pushed), pushed, CAMERA)[0] < 0.02


def test_a_thing_that_goes_around_is_followed_without_delay() -> None:
    segmenter = Segmenter()
    for index in range(40):
        angle = 2 * np.pi * index / 30
        moved = replace(BOXES[1], x=0.06 * np.cos(angle), y=0.06 * np.sin(angle))
        each = of_box(segmenter.process(seen(CAMERA, (BOXES[0], moved), index=index)), moved)
        assert index < 10 or errors(each, moved, CAMERA)[0] < 0.02


def test_objects_that_are_asked_for_again_or_late_are_those_of_their_frame() -> None:
    segmenter = Segmenter()
    results = [segmenter.process(seen(CAMERA, index=index)) for index in range(4)]
    last = results[3].objects
    assert replace(results[3], elapsed_ms={}).objects is last
    early = results[1].objects
    assert {each.label for each in early} == {each.label for each in last}
    assert all(each.track.seen_s == 0.0 for each in early)
    after = segmenter.process(seen(CAMERA, index=4)).objects
    assert after[0].track.seen_s == pytest.approx(1 / 30, abs=1e-3)


def test_frames_without_numbers_and_times_are_followed_at_the_usual_rate() -> None:
    segmenter, box = Segmenter(), BOXES[1]
    for index in range(30):
        pushed = replace(box, x=box.x + 0.15 * index / 30)
        frame = replace(seen(CAMERA, (BOXES[0], pushed), index=index), index=0, timestamp_ns=0)
        objects = segmenter.process(frame).objects
        assert objects[0].track.seen_s == pytest.approx(index / 30, abs=1e-3)
    found = min(objects, key=lambda each: float(np.abs(each.mean_color - box.color).sum()))
    assert errors(found, pushed, CAMERA)[0] < 0.02


def test_a_turn_and_a_shift_are_found_though_one_thing_moved_by_itself() -> None:
    rng = np.random.default_rng(1)
    seen_m = rng.uniform(-1, 1, (6, 3))
    c, s = np.cos(0.05), np.sin(0.05)
    motion = np.array([[c, -s, 0, 0.02], [s, c, 0, -0.03], [0, 0, 1, 0], [0, 0, 0, 1]])
    known_m = seen_m @ motion[:3, :3].T + motion[:3, 3]
    known_m[2, :2] += 0.3
    np.testing.assert_allclose(world_from_support(known_m, seen_m, np.eye(4)), motion, atol=2e-3)
    np.testing.assert_array_equal(world_from_support(known_m[:1], seen_m[:1], motion), motion)


def test_boxes_are_brought_down_to_the_level_below_them_where_little_is_missing() -> None:
    support = Support(np.array([0.0, 1.0, 0.0]), 1.0, "largest", np.array([0.0, 0.3]))
    # 2 cm above the table, 20 cm above it, 1 cm above the shelf, and as flat as the table.
    low, high = np.array([-0.98, -0.8, -0.69, -1.0]), np.array([-0.78, -0.6, -0.59, -0.995])
    np.testing.assert_allclose(standing(support, low, high), [-1.0, -0.8, -0.7, -1.0])
    # A ball of 9 cm hides its lowest fourth; 3 cm below what is 9 cm high are too much.
    low, high = np.array([-0.977, -0.97]), np.array([-0.91, -0.91])
    np.testing.assert_allclose(standing(support, low, high), [-1.0, -0.97])


def test_a_wall_does_not_replace_a_table_that_is_out_of_sight() -> None:
    table = process_frame(seen(CAMERA)).objects[0].support
    wall = StandingBox(0.0, 0.6, (3.0, 0.1, 2.0), 0.0, (90, 90, 90))
    result = process_frame(seen(looking((0.0, -0.5, 1.0), (0.0, 0.6, 1.2)), (wall,)))
    assert find_support(result.cloud, result.tree, noise=0.0025) is not None
    assert find_support(result.cloud, result.tree, noise=0.0025, before=table) is None


def test_what_stands_before_an_object_hides_its_border() -> None:
    front = StandingBox(-0.1, -0.2, (0.16, 0.04, 0.2), 0.0, (230, 200, 30))
    result = process_frame(seen(CAMERA, (*BOXES, front)))
    assert of_box(result, BOXES[0]).hidden_share > 0.2 > of_box(result, front).hidden_share


def test_what_stands_within_the_outline_of_a_table_is_no_reason_to_doubt_its_box() -> None:
    table = StandingBox(0.0, 0.1, (0.9, 0.66, 0.2), 0.0, (180, 170, 150))
    places = [(x, y) for x in (-0.3, -0.15, 0.0, 0.15, 0.3) for y in (-0.06, 0.06, 0.18)]
    things = [StandingBox(*place, (0.07, 0.07, 0.3), 0.0, (90, 60, 200)) for place in places]
    front = StandingBox(-0.2, -0.3, (0.4, 0.04, 0.5), 0.0, (20, 20, 60))
    camera = looking((0.0, -0.45, 1.35), (0.0, 0.1, 0.2))
    within, before = (
        of_box(process_frame(seen(camera, (table, *each))), table) for each in (things, [front])
    )
    # More than half of all its border is that to the things.
    assert within.hidden_share < 0.01 and within.is_sure
    np.testing.assert_allclose(within.box.size_m, table.size, atol=0.015)
    assert before.hidden_share > 0.1
    both = of_box(process_frame(seen(camera, (table, *things, front))), table)
    assert both.hidden_share == pytest.approx(before.hidden_share, abs=0.03)
