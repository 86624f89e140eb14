"""The cameras of other programs' recordings: as they state them, or an error that says what is missing."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_scene import APART, CAMERA, INTERVAL_NS, scene, scenes
from robot_bag import Bag, shifted

from nurbseg.drivers import CalibrationError, Intrinsics, RecordingFormatError, SourceOptions, open_source

START_NS = scene(0).timestamp_ns
DEPTH, COLOR = "cam_depth_optical", "cam_color_optical"
GIVEN = SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))


def camera(fx: float, width: int = 64, height: int = 48) -> Intrinsics:
    return Intrinsics(width, height, fx, fx, (width - 1) / 2, (height - 1) / 2)


def one_frame(
    path: Path,
    *,
    infos: tuple[str, ...] = ("depth", "color"),
    frames: tuple[str, str] = (COLOR, COLOR),
    names: tuple[str, str] = ("cam/depth/image_raw", "cam/color/image_raw"),
    given: Intrinsics = CAMERA,
    transform: bool = False,
    **values: Any,
) -> Path:
    """A recording of one frame; `values` are fields of both CameraInfo messages."""
    bag, frame = Bag(path / "bag.mcap"), scene(0)
    for kind, frame_id in zip(("depth", "color"), frames, strict=True):
        if kind in infos:
            bag.info(f"/cam/{kind}/camera_info", START_NS, frame_id, given, **values)
    bag.image(f"/{names[0]}", START_NS, frames[0], frame.depth_mm, "16UC1")
    bag.image(f"/{names[1]}", START_NS, frames[1], frame.color, "rgb8")
    if transform:
        bag.transform("/tf_static", START_NS, COLOR, DEPTH, shifted(0.05))
    return bag.close()


ONE_CAMERA = rf"'{DEPTH}'.*'{COLOR}'.*only CameraInfo.*--calibration"
#: What a recording of one frame states, and what is said of it.
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"infos": ()}, r"bag\.mcap: no sensor_msgs/CameraInfo.*--intrinsics"),
    ({"infos": ("depth",), "frames": (DEPTH, COLOR), "transform": True}, ONE_CAMERA),
    ({"infos": ("color",), "frames": (DEPTH, COLOR), "transform": True}, ONE_CAMERA),
    ({"frames": (DEPTH, COLOR)}, rf"bag\.mcap: no transform from '{DEPTH}' to '{COLOR}'"),
    ({"k": np.zeros(9), "p": np.zeros(12)}, "camera_info.*k: the camera is not calibrated.*--intrinsics"),
    ({"k": [np.nan, *np.zeros(7), 1.0]}, "camera_info.*k: expected finite"),
    ({"d": [np.nan] * 5}, "camera_info.*distortion: expected finite"),
    ({"d": [0.1, 0.2, 0.3]}, "camera_info.*distortion: expected .* coefficients, got 3"),
    ({"distortion_model": "equidistant", "d": [0.1, 0, 0, 0]}, "distortion_model: .*got 'equidistant'"),
    ({"k": [0.82, 0, 0.5, 0, 1.09, 0.5, 0, 0, 1]}, "fx, fy: expected focal lengths in pixels of 64x48"),
    (
        {"given": Intrinsics(128, 96, 52.5, 52.5, 31.5, 23.5), "binning_x": 2, "binning_y": 2},
        "binning_x: 2, but the principal point .* binned images already",
    ),
    (
        {"given": Intrinsics(64, 48, 52.5, 52.5, 31.5, 60.0)},
        r"camera_info: .*principal point 31\.5, 60 is outside",
    ),
]


@pytest.mark.parametrize("place", range(len(REFUSED)))
def test_a_camera_that_is_missing_or_unusable_is_named_and_the_users_counts(tmp_path, place):
    values, said = REFUSED[place]
    path = one_frame(tmp_path, **values)
    with pytest.raises(CalibrationError, match=said):
        open_source(path)
    with open_source(path, GIVEN) as source:
        assert source.read().calibration.is_registered


P = [60.0, 0, 30.0, 0, 0, 61.0, 22.0, 0, 0, 0, 1, 0]
DISTORTED = replace(CAMERA, distortion=np.array([0.1, -0.02, 0, 0, 0]))
NESTED = ("cam/depth/raw/image", "cam/color/raw/image")
RECTIFIED = ("cam/depth/image_rect", "cam/color/image_rect_color")


@pytest.mark.parametrize(
    ("names", "values", "fx", "distorted"),
    [
        (RECTIFIED, {"p": P}, 60.0, False),
        (("cam/depth/rectified/image", "cam/color/image_rect"), {"p": P}, 60.0, False),
        (("cam/depth/image_raw", "cam/color/image_raw"), {"p": P}, CAMERA.fx, True),
        (("cam/depth/image_rect_raw", "cam/color/image_raw"), {"p": P}, CAMERA.fx, True),
        (("cam/direct/depth/image", "cam/rectangle/color"), {"p": P}, CAMERA.fx, True),
        # Without P, K is that of the images; without K, P is (Ensenso).
        (RECTIFIED, {"p": [0.0] * 12}, CAMERA.fx, False),
        # Some drivers fill in the 1 of its last row only.
        (RECTIFIED, {"p": [*[0.0] * 10, 1.0, 0.0]}, CAMERA.fx, False),
        (("cam/depth/image", "cam/color/image"), {"k": [0.0] * 9, "p": P}, 60.0, False),
        # Whatever the lens was, it is undone.
        (
            ("cam/depth/image_rect", "cam/color/image_rect"),
            {"p": P, "distortion_model": "equidistant"},
            60.0,
            False,
        ),
    ],
)
def test_rectified_images_have_the_camera_of_p(tmp_path, names, values, fx, distorted):
    with open_source(one_frame(tmp_path, names=names, given=DISTORTED, **values)) as source:
        assert source.calibration.depth.fx == fx
        assert source.calibration.depth.distortion.any() == distorted


REGION = {"x_offset": 60, "y_offset": 40, "width": 64, "height": 48}
WIDE = {"x_offset": 100, "y_offset": 80, "width": 128, "height": 96}


@pytest.mark.parametrize(
    ("full", "values", "expected"),
    [
        # Every second pixel of twice the size; a window of it; both; sizes that are right already.
        (camera(105.0, 128, 96), {"binning_x": 2, "binning_y": 2}, (52.5, 31.5, 23.5)),
        (Intrinsics(200, 100, 80.0, 80.0, 90.0, 60.0), {"roi": REGION}, (80.0, 30.0, 20.0)),
        (
            Intrinsics(400, 300, 80.0, 80.0, 163.5, 123.5),
            {"binning_x": 2, "binning_y": 2, "roi": WIDE},
            (40.0, 31.5, 21.5),
        ),
        (CAMERA, {"binning_x": 4, "binning_y": 4}, (52.5, 31.5, 23.5)),
        (camera(105.0, 128, 96), {}, (52.5, 31.5, 23.5)),
    ],
)
def test_binning_and_region_of_interest_are_heeded(tmp_path, full, values, expected):
    with open_source(one_frame(tmp_path, given=full, **values)) as source:
        found = source.read().calibration.depth
    assert (found.fx, found.cx, found.cy) == pytest.approx(expected)
    assert (found.width, found.height) == (64, 48)


@pytest.mark.parametrize(
    ("frames", "info", "said"),
    [
        ((COLOR, COLOR), "depth", ""),
        ((COLOR, COLOR), "color", ""),
        (("", COLOR), "depth", "names no frame: they are taken as registered"),
        # Beside the images' folder.
        (("", ""), "depth", ""),
    ],
)
def test_images_of_one_frame_need_one_camera(tmp_path: Path, frames, info: str, said: str, caplog) -> None:
    with open_source(one_frame(tmp_path, infos=(info,), frames=frames, names=NESTED)) as source:
        assert source.calibration.is_registered
    assert said in caplog.text


@pytest.mark.parametrize("name", ["aligned_depth_to_color", "rgb_depth"])
def test_depth_in_the_frame_of_color_comes_first_with_the_camera_that_is_beside_it(tmp_path, name):
    bag = Bag(tmp_path / "bag.mcap")
    for topic, frame_id, fx in (("depth", DEPTH, 50.0), (name, COLOR, 40.0), ("color", COLOR, 60.0)):
        bag.info(f"/cam/{topic}/camera_info", START_NS, frame_id, camera(fx))
        image, encoding = (scene(0).color, "rgb8") if topic == "color" else (scene(0).depth_mm, "16UC1")
        bag.image(f"/cam/{topic}/image_raw", START_NS, frame_id, image, encoding)
    bag.transform("/tf_static", START_NS, COLOR, DEPTH, shifted(0.05))
    with open_source(bag.close()) as source:
        assert source.metadata["depth_topic"] == f"/cam/{name}/image_raw"
        assert (source.calibration.depth.fx, source.calibration.color.fx) == (40.0, 60.0)


def test_the_baseline_of_rectified_cameras_in_one_frame_is_that_of_p(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    # The color camera is 0.12 m to the right: points are as far to the left in it.
    for kind, tx in (("depth", 0.0), ("rgb", -0.12 * 60.0)):
        bag.info(f"/cam/{kind}/camera_info", START_NS, "left", CAMERA, p=[*P[:3], tx, *P[4:]])
    bag.image("/cam/depth/image_rect", START_NS, "left", scene(0).depth_mm, "16UC1")
    bag.image("/cam/rgb/image_rect_color", START_NS, "left", scene(0).color, "rgb8")
    with open_source(bag.close()) as source:
        np.testing.assert_allclose(source.calibration.color_from_depth, shifted(-0.12), atol=1e-12)


@pytest.mark.parametrize("topic", ["/tf_static", "/tf"])
def test_transforms_go_by_way_of_other_frames_wherever_they_are(tmp_path: Path, topic: str) -> None:
    """As a robot's driver describes its cameras, with other topics beside."""
    bag = Bag(tmp_path / "bag.mcap")
    link_from_depth = shifted(0.1)
    for frame in scenes(90, APART):
        stamp = frame.timestamp_ns
        bag.image("/cam/infra/image_rect", stamp, "infra", frame.depth_mm, "mono16")
        bag.image("/cam/infra/image_mono", stamp, "infra", (frame.depth_mm >> 8).astype(np.uint8), "mono8")
        bag.info("/cam/infra/camera_info", stamp, "infra", CAMERA)
        # As ROS 1 named frames.
        bag.info("/cam/depth/camera_info", stamp, f"/{DEPTH}", APART.depth)
        bag.info("/cam/color/camera_info", stamp, COLOR, APART.color)
        bag.image("/cam/depth/image_rect_raw", stamp, f"/{DEPTH}", frame.depth_mm, "16UC1")
        bag.image("/cam/color/image_raw", stamp, COLOR, frame.color, "rgb8")
    bag.transform(topic, stamp, "link", DEPTH, link_from_depth)
    bag.transform(topic, stamp, "link", COLOR, link_from_depth @ np.linalg.inv(APART.color_from_depth))
    with open_source(bag.close()) as source:
        np.testing.assert_allclose(source.calibration.color_from_depth, APART.color_from_depth, atol=1e-9)
        np.testing.assert_array_equal(source.calibration.color.matrix, APART.color.matrix)
        np.testing.assert_array_equal(source.read().depth_mm, scene(0, APART).depth_mm)


def two_cameras(path: Path, first: str = "/cam1", second: str = "/cam2") -> Bag:
    bag = Bag(path / "bag.mcap")
    for index, name in enumerate((second, first)):
        for frame in scenes(3):
            seen = replace(frame, depth_mm=frame.depth_mm + 1000 * index)
            bag.camera(name, seen, camera(50.0 + index), frame.timestamp_ns + 1_000_000 * index)
    return bag


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("/cam1", "/cam2"),
        ("/camera_1", "/camera_2"),
        ("/robot/back_camera", "/robot/front_camera"),
        ("/left_camera", "/right_camera"),
        ("/device_0/sensor_1", "/device_1/sensor_1"),
    ],
)
def test_two_cameras_are_never_mixed_and_flags_choose(tmp_path, first, second, caplog):
    path = two_cameras(tmp_path, first, second).close()
    depth, color = (f"{{}}/{kind}/image_raw" for kind in ("depth", "color"))
    for name, options, fx, further in (
        (first, None, 51.0, 1000),
        (second, SourceOptions(depth_topic=depth.format(second)), 50.0, 0),
        (second, SourceOptions(color_topic=color.format(second)), 50.0, 0),
    ):
        with open_source(path, options) as source:
            topics = source.metadata["depth_topic"], source.metadata["color_topic"]
            assert topics == (depth.format(name), color.format(name))
            assert source.calibration.depth.fx == fx
            np.testing.assert_array_equal(source.read().depth_mm, scene(0).depth_mm + further)
    said = f"has 2 cameras: {depth.format(first)} is replayed with {color.format(first)}; --depth-topic"
    assert said in caplog.text


@pytest.mark.parametrize(
    ("depth", "color", "is_one"),
    [
        ("camera1/aligned_depth_to_color/image_raw", "camera1/color/image_raw", True),
        ("camera_2/depth/image", "camera_2/color/image_raw", True),
        ("camera_2/depth/image", "camera_1/color/image_raw", False),
        ("robot/front_camera/infra1/depth", "robot/front_camera/color/image", True),
        ("device_0/sensor_0/Depth_0/image/data", "device_0/sensor_1/Color_0/image/data", True),
        ("device_0/sensor_0/Depth_0/image/data", "device_1/sensor_1/Color_0/image/data", False),
        ("a/depth_0/image", "a/color_1/image", True),
        ("oak/stereo/depth", "oak/rgb/image", True),
        ("left_depth/image", "left_color/image", True),
        ("left_depth/image", "right_color/image", False),
    ],
)
def test_names_say_whose_images_are(tmp_path: Path, depth: str, color: str, is_one: bool) -> None:
    path = one_frame(tmp_path, infos=(), frames=(DEPTH, COLOR), names=(depth, color))
    with open_source(path, GIVEN) as source:
        assert source.metadata["color_topic"] == (f"/{color}" if is_one else "none")


def test_depth_and_color_of_two_cameras_are_a_rig_where_a_transform_says_it(tmp_path: Path) -> None:
    names = ("cam1/depth/image", "cam2/color/image")
    with open_source(one_frame(tmp_path, frames=(DEPTH, COLOR), names=names, transform=True)) as source:
        assert source.metadata["color_topic"] == "/cam2/color/image"
        np.testing.assert_allclose(source.calibration.color_from_depth, shifted(0.05))


def test_topics_that_are_not_there_or_of_two_cameras_are_refused(tmp_path: Path) -> None:
    path = two_cameras(tmp_path).close()
    for options, error, said in (
        ({"depth_topic": "/x"}, RecordingFormatError, "--depth-topic /x: no such topic; topics: .*/cam1/"),
        (
            {"color_topic": "/cam1/depth/image_raw"},
            RecordingFormatError,
            "--color-topic /cam1/depth/image_raw: not color images",
        ),
        (
            {"depth_topic": "/cam2/depth/image_raw", "color_topic": "/cam1/color/image_raw"},
            CalibrationError,
            "no transform from 'cam2_optical' to 'cam1_optical'",
        ),
    ):  # fmt: skip
        with pytest.raises(error, match=said):
            open_source(path, SourceOptions(**options))


@pytest.mark.parametrize("complete", [True, False])
def test_the_first_complete_camera_is_taken_and_depth_of_another_is_gray(tmp_path, complete, caplog):
    bag = two_cameras(tmp_path, "/cam2", "/cam3") if complete else Bag(tmp_path / "bag.mcap")
    bag.info("/cam1/depth/camera_info", START_NS, "cam1_optical", CAMERA)
    bag.image("/cam1/depth/image_raw", START_NS, "cam1_optical", scene(0).depth_mm, "16UC1")
    bag.image("/cam0/color/image_raw", START_NS, "cam0_optical", scene(0).color, "rgb8")
    with open_source(bag.close()) as source:
        topics = source.metadata["depth_topic"], source.metadata["color_topic"]
        if complete:
            assert topics == ("/cam2/depth/image_raw", "/cam2/color/image_raw")
            return
        assert topics == ("/cam1/depth/image_raw", "none")
        frame = source.read()
    assert (frame.color == 128).all() and frame.color.shape == (48, 64, 3)
    assert frame.calibration.is_registered
    assert "has no color images of the camera of /cam1/depth/image_raw: gray instead" in caplog.text


def test_a_camera_without_calibration_gives_way_to_the_next(tmp_path: Path) -> None:
    bag = two_cameras(tmp_path, "/cam2", "/cam3")
    bag.image("/cam1/depth/image_raw", START_NS, "cam1", scene(0).depth_mm, "16UC1")
    bag.image("/cam1/color/image_raw", START_NS, "cam1", scene(0).color, "rgb8")
    with open_source(bag.close()) as source:
        assert source.metadata["depth_topic"] == "/cam2/depth/image_raw"


@pytest.mark.parametrize("info_is_first", [True, False])
def test_frames_have_the_camera_that_their_own_camera_info_says(tmp_path, info_is_first, caplog):
    bag = Bag(tmp_path / "bag.mcap")
    expected = []
    for index in range(30):
        stamp = START_NS + index * INTERVAL_NS
        step = 2 if 10 <= index < 20 else 1
        own = camera(25.0, 32, 24) if step == 2 else camera(50.0 if index < 5 else 70.0)
        depth, color = scene(index).depth_mm[::step, ::step], scene(index).color[::step, ::step]
        expected.append((own.width, own.height, own.fx))
        parts: list[Callable[[], None]] = [
            lambda own=own, stamp=stamp: bag.info("/cam/camera_info", stamp, COLOR, own),
            lambda depth=depth, stamp=stamp: bag.image("/cam/depth/image", stamp, COLOR, depth, "16UC1"),
            lambda color=color, stamp=stamp: bag.image("/cam/color/image", stamp, COLOR, color, "rgb8"),
        ]  # type: ignore[misc]
        for part in parts if info_is_first else parts[::-1]:
            part()
    with open_source(bag.close()) as source:
        found = [frame.calibration.depth for frame in source]
        assert [(each.width, each.height, each.fx) for each in found] == expected
        for index in (12, 3):
            source.seek(index)
            assert source.read().calibration.depth.fx == expected[index][2]
    assert "frame 10: the cameras change, to 32 x 24 with fx 25.0" in caplog.text
