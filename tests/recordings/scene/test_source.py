import re

import numpy as np
import pytest

from nurbseg.common.errors import EndOfRecordingError
from scene.scene import PERIOD
from scene.shapes import RECTANGLE
from scene.source import SyntheticOptions, SyntheticSource

TINY = {"width": 160, "height": 120}


def frame_at(source, index):
    source.seek(index)
    return source.read()


def exact_depth_m(source, index):
    """Depth before any fault, (H, W); inf where there is nothing."""
    return source._depth.render(source._scene.world_from_depth(index), index).depth_m


def points_m(source, index):
    """Back-projected exact depth, (H, W, 3)."""
    depth = exact_depth_m(source, index)
    rays = source.calibration.depth.rays()
    return np.concatenate([rays * depth[..., None], depth[..., None]], axis=-1)


def exact_labels(source, index):
    return source._depth.render(source._scene.world_from_depth(index), index).objects


def carried(points, transform):
    return points @ transform[:3, :3].T + transform[:3, 3]


def same_frames(a, b):
    return (
        np.array_equal(a.depth_mm, b.depth_mm)
        and np.array_equal(a.color, b.color)
        and np.array_equal(a.labels, b.labels)
    )


def test_the_same_options_give_the_same_frames():
    with SyntheticSource(SyntheticOptions(seed=4, **TINY)) as first:
        frames = [first.read() for _ in range(3)]
    with SyntheticSource(SyntheticOptions(seed=4, **TINY)) as second:
        assert all(same_frames(frame, second.read()) for frame in frames)
    with SyntheticSource(SyntheticOptions(seed=5, **TINY)) as other:
        assert not same_frames(frames[0], other.read())
    assert not same_frames(frames[0], frames[1])


def test_frames_do_not_depend_on_what_was_read_before():
    with SyntheticSource(SyntheticOptions(**TINY)) as source:
        assert source.skip(5) == 5
        frame = source.read()
        assert frame.index == 5
        assert same_frames(frame, frame_at(source, 5))


def test_each_texture_fills_its_own_window_of_the_atlas():
    with SyntheticSource(SyntheticOptions(**TINY)) as source:
        atlas, windows = source._depth._atlas
        for each, (column, row, right, down) in zip(source._scene.objects, windows.astype(int), strict=True):
            part = atlas[row : row + down + 1, column : column + right + 1]
            assert part.shape == each.texture.shape
            # The light is baked into the flat ones.
            assert np.array_equal(part, each.texture) == (each.shape.kind != RECTANGLE)


def test_a_sequence_ends_and_stamps_follow_its_rate():
    with SyntheticSource(SyntheticOptions(frames=4, fps=15, **TINY)) as source:
        frames = list(source)
        assert [frame.index for frame in frames] == [0, 1, 2, 3]
        assert [frame.timestamp_ns for frame in frames] == [0, 66_666_667, 133_333_333, 200_000_000]
        with pytest.raises(EndOfRecordingError, match="after 4 frames"):
            source.read()
        assert source.skip(3) == 0


def test_the_scene_moves_as_fast_at_any_rate():
    with (
        SyntheticSource(SyntheticOptions(fps=10, **TINY)) as slow,
        SyntheticSource(SyntheticOptions(fps=30, **TINY)) as fast,
    ):
        assert frame_at(slow, 3).timestamp_ns == frame_at(fast, 9).timestamp_ns
        assert np.array_equal(frame_at(slow, 3).color, frame_at(fast, 9).color)
        assert np.array_equal(slow.poses(3)[0], fast.poses(9)[0])


def test_every_labelled_point_lies_in_its_objects_box_in_its_own_frame():
    with SyntheticSource(SyntheticOptions(noise=False, **TINY)) as source:
        for index in (0, 31):
            frame, (world_from_depth, world_from_object) = frame_at(source, index), source.poses(index)
            world = carried(points_m(source, index), world_from_depth)
            assert set(np.unique(frame.labels)) == set(source.label_names)
            for number, each in enumerate(source._scene.objects):
                mine = carried(
                    world[frame.labels == number + 1], np.linalg.inv(world_from_object[number + 1])
                )
                low, high = each.shape.corners_m.min(axis=0), each.shape.corners_m.max(axis=0)
                assert (mine > low - 1e-4).all() and (mine < high + 1e-4).all()


def test_depth_and_labels_agree_with_casting_each_ray_on_its_own():
    with SyntheticSource(SyntheticOptions(noise=False, offset=True, distortion=True, **TINY)) as source:
        frame, (world_from_depth, world_from_object) = frame_at(source, 12), source.poses(12)
        rays = source.calibration.depth.rays()
        rng = np.random.default_rng(0)
        for row, col in rng.integers(0, (120, 160), (150, 2)):
            best, label = np.inf, 0
            ray = np.array([*rays[row, col], 1.0])
            for number, each in enumerate(source._scene.objects):
                inverse = np.linalg.inv(world_from_object[number + 1]) @ world_from_depth
                origin, direction = inverse[:3, 3], inverse[:3, :3] @ ray
                t, _ = each.shape.hit(*(a[None].astype(np.float32) for a in (origin, direction)))
                if t[0] < best:
                    best, label = t[0], number + 1
            assert frame.depth_mm[row, col] == pytest.approx(best * 1000, abs=0.51)
            assert frame.labels[row, col] == label


@pytest.mark.parametrize("label", [1, 3, 8, 12], ids=["table", "carton", "melon", "rolling ball"])
def test_the_given_poses_carry_each_objects_points_into_the_next_frame(label):
    # The ball turns by a fifth of a radian per frame where it is fastest.
    first_index, second_index = (20, 21) if label == 12 else (20, 23)
    with SyntheticSource(SyntheticOptions(noise=False, width=320, height=240)) as source:
        (depth_before, before), (depth_after, after) = (
            source.poses(index) for index in (first_index, second_index)
        )
        first, second = frame_at(source, first_index), frame_at(source, second_index)
        points = points_m(source, first_index)[first.labels == label]
        there = np.linalg.inv(depth_after) @ after[label] @ np.linalg.inv(before[label]) @ depth_before
        moved = carried(points, there)
        camera = source.calibration.depth
        col = np.rint(moved[:, 0] / moved[:, 2] * camera.fx + camera.cx).astype(int)
        row = np.rint(moved[:, 1] / moved[:, 2] * camera.fy + camera.cy).astype(int)
        inside = (col >= 0) & (col < 320) & (row >= 0) & (row < 240)
        depth = exact_depth_m(source, second_index)[row[inside], col[inside]]
        seen = depth > moved[inside, 2] - 0.01
        assert (second.labels[row[inside], col[inside]] == label)[seen].mean() > 0.95
        assert seen.mean() > 0.8


def test_faults_touch_depth_only_and_leave_most_of_it():
    with (
        SyntheticSource(SyntheticOptions(**TINY)) as real,
        SyntheticSource(SyntheticOptions(noise=False, **TINY)) as exact,
    ):
        a, b = frame_at(real, 7), frame_at(exact, 7)
        assert np.array_equal(a.labels, b.labels) and np.array_equal(a.color, b.color)
        measured = a.depth_mm > 0
        assert 0.9 < measured.mean() < 0.999
        assert (b.depth_mm > 0).all()
        error = np.abs(a.depth_mm.astype(int) - b.depth_mm)[measured]
        assert 1 < np.median(error) < 10


def test_surface_labels_part_objects_and_never_join_them():
    with (
        SyntheticSource(SyntheticOptions(**TINY)) as objects,
        SyntheticSource(SyntheticOptions(labels="surfaces", **TINY)) as surfaces,
    ):
        whole, parts = frame_at(objects, 3).labels, frame_at(surfaces, 3).labels
        assert len(np.unique(parts)) >= len(np.unique(whole)) + 5
        assert set(np.unique(parts)) <= set(surfaces.label_names)
        assert list(surfaces.label_names) == list(range(1, len(surfaces.label_names) + 1))
        for part in np.unique(parts):
            (label,) = np.unique(whole[parts == part])
            assert surfaces.label_names[int(part)].startswith(objects.label_names[int(label)])


@pytest.mark.parametrize("hide", [3, 10])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_ball_is_hidden_for_about_as_many_frames_as_requested_and_never_for_more(hide, seed):
    options = SyntheticOptions(hide=hide, seed=seed, width=320, height=240)
    with SyntheticSource(options) as source:
        ball = next(label for label, name in source.label_names.items() if name == "ball")
        visible = [bool((exact_labels(source, index) == ball).any()) for index in range(PERIOD)]
    runs = "".join("." if each else "#" for each in visible)
    assert max(map(len, runs.split("."))) <= hide
    # Halfway it is behind the carton, and it comes out again.
    behind_carton = max(runs[PERIOD // 2 - 10 : PERIOD // 2 + 20].split("."), key=len)
    assert len(behind_carton) >= hide - 2


def test_separate_cameras_see_the_scene_from_two_places():
    options = SyntheticOptions(offset=True, distortion=True, color_width=320, color_height=256, **TINY)
    with SyntheticSource(options) as source:
        frame = source.read()
        assert frame.color.shape == (256, 320, 3) and frame.depth_mm.shape == (120, 160)
        calibration = frame.calibration
        assert not calibration.is_registered
        assert np.linalg.norm(calibration.color_from_depth[:3, 3]) == pytest.approx(0.025, abs=1e-3)
        assert calibration.depth.distortion.any() and calibration.color.distortion.any()


def test_a_text_sets_every_option():
    text = "frames=7&width=64&height=48&color_width=80&color_height=60&fps=15.5&seed=3&noise=0"
    expected = SyntheticOptions(7, 64, 48, 80, 60, 15.5, 3, False, True, True, "surfaces", 4)
    assert SyntheticOptions.from_text(f"{text}&offset=1&distortion=true&labels=surfaces&hide=4") == expected
    assert SyntheticOptions.from_text("") == SyntheticOptions()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame=7", "frame: unknown; expected one of frames, width"),
        ("frames=many", "frames: expected a whole number, at least 1, got 'many'"),
        ("frames=0", "frames: expected a whole number, at least 1, got 0"),
        ("frames=2&frames=3", "frames: given twice"),
        ("noise=yes", "noise: expected true or false, got 'yes'"),
        ("fps=0", "fps: expected a finite number, more than 0, got 0"),
        ("fps=nan", "fps: expected a finite number, more than 0, got nan"),
        ("fps=", "fps: expected a finite number, more than 0, got ''"),
        ("labels=parts", "labels: expected one of objects, surfaces"),
        ("distortion=1", "distortion: expected offset=1"),
        ("offset=1&color_width=80", "expected both or neither"),
        ("color_width=80&color_height=60", "color_width: expected offset=1"),
        ("garbage", "garbage"),
    ],
)
def test_a_text_that_makes_no_sense_is_refused_with_its_reason(text, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        SyntheticOptions.from_text(text)
