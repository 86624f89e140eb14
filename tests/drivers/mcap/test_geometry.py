"""The cameras of other programs' recordings: as they state them, or an error that says what is missing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_scene import APART, CAMERA, INTERVAL_NS, scene, scenes
from robot_bag import Bag, encoded, shifted

from nurbseg.drivers import CalibrationError, Intrinsics, RecordingFormatError, SourceOptions, open_source
from nurbseg.drivers.mcap.topics import camera_name, is_rectified

START_NS = scene(0).timestamp_ns
DEPTH, COLOR = "cam_depth_optical", "cam_color_optical"


def camera(fx: float, width: int = 64, height: int = 48) -> Intrinsics:
    return Intrinsics(width, height, fx, fx, (width - 1) / 2, (height - 1) / 2)


def one_frame(
    path: Path,
    *,
    infos: tuple[str, ...] = ("depth", "color"),
    frames: tuple[str, str] = (COLOR, COLOR),
    names: tuple[str, str] = ("depth/image_raw", "color/image_raw"),
    given: Intrinsics = CAMERA,
    **values: Any,
) -> Bag:
    """A recording of one frame; `values` are fields of both CameraInfo messages."""
    bag, frame = Bag(path), scene(0)
    for kind, frame_id in zip(("depth", "color"), frames, strict=True):
        if kind in infos:
            bag.info(f"/cam/{kind}/camera_info", START_NS, frame_id, given, **values)
    bag.image(f"/cam/{names[0]}", START_NS, frames[0], frame.depth_mm, "16UC1")
    bag.image(f"/cam/{names[1]}", START_NS, frames[1], frame.color, "rgb8")
    return bag


@pytest.mark.parametrize("info", ["depth", "color"])
def test_images_of_two_frames_with_one_camera_are_never_taken_as_registered(
    tmp_path: Path, info: str
) -> None:
    bag = one_frame(tmp_path / "bag.mcap", infos=(info,), frames=(DEPTH, COLOR))
    bag.transform("/tf_static", START_NS, COLOR, DEPTH, shifted(0.05))
    path = bag.close()
    with pytest.raises(CalibrationError, match=rf"'{DEPTH}'.*'{COLOR}'.*only CameraInfo.*--calibration"):
        open_source(path)
    with open_source(path, SourceOptions(intrinsics=(50, 50, 31, 23))) as source:
        assert source.calibration.is_registered


@pytest.mark.parametrize("info", ["depth", "color"])
def test_images_of_one_frame_need_one_camera(tmp_path: Path, info: str) -> None:
    with open_source(one_frame(tmp_path / "bag.mcap", infos=(info,)).close()) as source:
        assert source.calibration.is_registered


def test_frames_that_are_not_named_are_said(tmp_path: Path, caplog) -> None:
    with open_source(
        one_frame(tmp_path / "bag.mcap", infos=("depth",), frames=("", COLOR)).close()
    ) as source:
        assert source.calibration.is_registered
    assert "names no frame: they are taken as registered" in caplog.text


@pytest.mark.parametrize(
    ("topic", "fx", "registered"),
    [("aligned_depth_to_color", 40.0, True), ("aligned_depth_to_color", 57.0, False), ("depth", 40.0, False)],
)
def test_depth_that_is_registered_by_name_has_the_camera_of_color(
    tmp_path: Path, topic: str, fx: float, registered: bool, caplog
) -> None:
    # Some drivers state the depth camera's matrix beside it; rectifying changes a matrix a little.
    bag = Bag(tmp_path / "bag.mcap")
    bag.info(f"/cam/{topic}/camera_info", START_NS, COLOR, camera(fx))
    bag.info("/cam/color/camera_info", START_NS, COLOR, camera(60.0))
    bag.image(f"/cam/{topic}/image_raw", START_NS, COLOR, scene(0).depth_mm, "16UC1")
    bag.image("/cam/color/image_raw", START_NS, COLOR, scene(0).color, "rgb8")
    with open_source(bag.close()) as source:
        assert source.calibration.depth.fx == (60.0 if registered else fx)
        assert source.calibration.is_registered == registered
    assert ("contradicts" in caplog.text) == registered


P = [60.0, 0, 30.0, 0, 0, 61.0, 22.0, 0, 0, 0, 1, 0]
DISTORTED = replace(CAMERA, distortion=np.array([0.1, -0.02, 0, 0, 0]))


@pytest.mark.parametrize(
    ("names", "values", "fx", "distorted"),
    [
        (("depth/image_rect", "color/image_rect_color"), {"p": P}, 60.0, False),
        (("depth/image_raw", "color/image_raw"), {"p": P}, CAMERA.fx, True),
        (("depth/image_rect_raw", "color/image_raw"), {"p": P}, CAMERA.fx, True),
        # Without P, K is that of the images; without K, P is (Ensenso).
        (("depth/image_rect", "color/image_rect_color"), {"p": [0.0] * 12}, CAMERA.fx, False),
        # Some drivers fill in the 1 of its last row only.
        (("depth/image_rect", "color/image_rect_color"), {"p": [*[0.0] * 10, 1.0, 0.0]}, CAMERA.fx, False),
        (("depth/image", "color/image"), {"k": [0.0] * 9, "p": P}, 60.0, False),
        # Whatever the lens was, it is undone.
        (("depth/image_rect", "color/image_rect"), {"p": P, "distortion_model": "equidistant"}, 60.0, False),
    ],
)
def test_rectified_images_have_the_camera_of_p(
    tmp_path: Path, names: tuple[str, str], values: dict[str, Any], fx: float, distorted: bool
) -> None:
    path = one_frame(tmp_path / "bag.mcap", names=names, given=DISTORTED, **values).close()
    with open_source(path) as source:
        assert source.calibration.depth.fx == fx
        assert source.calibration.depth.distortion.any() == distorted


def test_names_say_whether_images_are_rectified_and_whose_they_are() -> None:
    rectified = [
        "/a/image_rect",
        "/a/image_rect_color",
        "/a/rectified/image",
        "/a/image_rect/compressedDepth",
    ]
    assert all(map(is_rectified, rectified))
    assert not any(map(is_rectified, ["/a/image_raw", "/a/image_rect_raw", "/direct/image", "/rectangle/x"]))
    for topic, name in {
        "/camera/depth/image_raw": (),
        "/camera1/aligned_depth_to_color/image_raw": ("camera1",),
        "/camera_2/color/image_raw/compressed": ("2",),
        "/robot/front_camera/infra1/image_rect_raw": ("robot", "front"),
        "/device_0/sensor_1/Color_0/image/data": ("device_0",),
        "/left_depth/image": ("left",),
    }.items():
        assert camera_name(topic) == name, topic


def test_the_baseline_of_rectified_cameras_in_one_frame_is_that_of_p(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    # The color camera is 0.12 m to the right: points are as far to the left in it.
    for kind, tx in (("depth", 0.0), ("rgb", -0.12 * 60.0)):
        bag.info(f"/cam/{kind}/camera_info", START_NS, "left", CAMERA, p=[*P[:3], tx, *P[4:]])
    bag.image("/cam/depth/image_rect", START_NS, "left", scene(0).depth_mm, "16UC1")
    bag.image("/cam/rgb/image_rect_color", START_NS, "left", scene(0).color, "rgb8")
    with open_source(bag.close()) as source:
        np.testing.assert_allclose(source.calibration.color_from_depth, shifted(-0.12), atol=1e-12)


@pytest.mark.parametrize(
    ("full", "values", "expected"),
    [
        # Every second pixel of twice the size; a window of it; both; sizes that are right already.
        (camera(105.0, 128, 96), {"binning_x": 2, "binning_y": 2}, (52.5, 31.5, 23.5)),
        (
            Intrinsics(200, 100, 80.0, 80.0, 90.0, 60.0),
            {"roi": {"x_offset": 60, "y_offset": 40, "width": 64, "height": 48, "do_rectify": False}},
            (80.0, 30.0, 20.0),
        ),
        (
            Intrinsics(400, 300, 80.0, 80.0, 163.5, 123.5),
            {
                "binning_x": 2,
                "binning_y": 2,
                "roi": {"x_offset": 100, "y_offset": 80, "width": 128, "height": 96, "do_rectify": False},
            },
            (40.0, 31.5, 21.5),
        ),
        (CAMERA, {"binning_x": 4, "binning_y": 4}, (52.5, 31.5, 23.5)),
        (camera(105.0, 128, 96), {}, (52.5, 31.5, 23.5)),
    ],
)
def test_binning_and_region_of_interest_are_heeded(
    tmp_path: Path, full: Intrinsics, values: dict[str, Any], expected: tuple[float, ...]
) -> None:
    with open_source(one_frame(tmp_path / "bag.mcap", given=full, **values).close()) as source:
        found = source.read().calibration.depth
        assert (found.fx, found.cx, found.cy) == pytest.approx(expected)
        assert (found.width, found.height) == (64, 48)


def test_a_matrix_of_binned_images_with_their_binning_again_is_refused(tmp_path: Path) -> None:
    twice = Intrinsics(128, 96, 52.5, 52.5, 31.5, 23.5)
    path = one_frame(tmp_path / "bag.mcap", given=twice, binning_x=2, binning_y=2).close()
    with pytest.raises(
        CalibrationError, match=r"binning_x: 2, but the principal point .* binned images already"
    ):
        open_source(path)


def two_cameras(path: Path, first: str = "/cam1", second: str = "/cam2") -> Bag:
    bag = Bag(path)
    for index, name in enumerate((second, first)):
        for frame in scenes(3):
            seen = replace(frame, depth_mm=frame.depth_mm + 1000 * index)
            bag.camera(name, seen, camera(50.0 + index), frame.timestamp_ns + 1_000_000 * index)
    return bag


def test_two_cameras_are_never_mixed_and_flags_choose(tmp_path: Path, caplog) -> None:
    path = two_cameras(tmp_path / "bag.mcap").close()
    with open_source(path) as source:
        assert (source.metadata["depth_topic"], source.metadata["color_topic"]) == (
            "/cam1/depth/image_raw",
            "/cam1/color/image_raw",
        )
        assert source.calibration.depth.fx == 51.0
        np.testing.assert_array_equal(source.read().depth_mm, scene(0).depth_mm + 1000)
    assert (
        "has 2 cameras: /cam1/depth/image_raw is replayed with /cam1/color/image_raw; --depth-topic"
        in caplog.text
    )
    with open_source(path, SourceOptions(depth_topic="/cam2/depth/image_raw")) as source:
        assert source.metadata["color_topic"] == "/cam2/color/image_raw"
        assert source.calibration.depth.fx == 50.0
        np.testing.assert_array_equal(source.read().depth_mm, scene(0).depth_mm)
    with pytest.raises(
        RecordingFormatError, match=r"--depth-topic /x: no such topic; topics: .*/cam1/depth/im"
    ):
        open_source(path, SourceOptions(depth_topic="/x"))
    with pytest.raises(RecordingFormatError, match="--color-topic /cam1/depth/image_raw: not color images"):
        open_source(path, SourceOptions(color_topic="/cam1/depth/image_raw"))
    both = SourceOptions(depth_topic="/cam2/depth/image_raw", color_topic="/cam1/color/image_raw")
    with pytest.raises(CalibrationError, match="no transform from 'cam2_optical' to 'cam1_optical'"):
        open_source(path, both)


def test_the_first_complete_camera_is_taken_and_depth_of_another_is_gray(tmp_path: Path, caplog) -> None:
    bag = two_cameras(tmp_path / "bag.mcap", "/cam2", "/cam3")
    bag.image("/cam1/depth/image_raw", START_NS, "cam1_optical", scene(0).depth_mm, "16UC1")
    bag.image("/cam0/color/image_raw", START_NS, "cam0_optical", scene(0).color, "rgb8")
    path = bag.close()
    with open_source(path) as source:
        assert source.metadata["depth_topic"] == "/cam2/depth/image_raw"
        assert source.metadata["color_topic"] == "/cam2/color/image_raw"
    lonely = Bag(tmp_path / "lonely.mcap")
    lonely.info("/cam1/depth/camera_info", START_NS, "cam1_optical", CAMERA)
    lonely.image("/cam1/depth/image_raw", START_NS, "cam1_optical", scene(0).depth_mm, "16UC1")
    lonely.image("/cam0/color/image_raw", START_NS, "cam0_optical", scene(0).color, "rgb8")
    with open_source(lonely.close()) as source:
        assert source.metadata["color_topic"] == "none"
        assert (source.read().color == 128).all()
    assert "has no color images of the camera of /cam1/depth/image_raw: gray instead" in caplog.text


@pytest.mark.parametrize("topic", ["/tf_static", "/tf"])
def test_transforms_count_wherever_they_are(tmp_path: Path, topic: str) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    for frame in scenes(90, APART):
        stamp = frame.timestamp_ns
        bag.info("/cam/depth/camera_info", stamp, DEPTH, APART.depth)
        bag.info("/cam/color/camera_info", stamp, COLOR, APART.color)
        bag.image("/cam/depth/image_raw", stamp, DEPTH, frame.depth_mm, "16UC1")
        bag.image("/cam/color/image_raw", stamp, COLOR, frame.color, "rgb8")
    bag.transform(topic, stamp, COLOR, DEPTH, APART.color_from_depth)
    with open_source(bag.close()) as source:
        np.testing.assert_allclose(source.calibration.color_from_depth, APART.color_from_depth, atol=1e-9)


@pytest.mark.parametrize("info_is_first", [True, False])
def test_frames_have_the_camera_that_their_own_camera_info_says(
    tmp_path: Path, info_is_first: bool, caplog
) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    expected = []
    for index in range(30):
        frame, stamp = scene(index), START_NS + index * INTERVAL_NS
        depth, color = frame.depth_mm, frame.color
        own = camera(50.0)
        if 10 <= index < 20:
            depth, color, own = depth[::2, ::2], color[::2, ::2], camera(25.0, 32, 24)
        elif index >= 20:
            own = camera(70.0)
        expected.append((own.width, own.height, own.fx))
        parts = [
            lambda own=own, stamp=stamp: bag.info("/cam/camera_info", stamp, COLOR, own),
            lambda depth=depth, stamp=stamp: bag.image("/cam/depth/image", stamp, COLOR, depth, "16UC1"),
            lambda color=color, stamp=stamp: bag.image("/cam/color/image", stamp, COLOR, color, "rgb8"),
        ]
        for part in parts if info_is_first else parts[::-1]:
            part()
    with open_source(bag.close()) as source:
        found = [each.calibration.depth for each in source]
        assert [(each.width, each.height, each.fx) for each in found] == expected
        source.seek(12)
        assert source.read().calibration.depth.fx == 25.0
        source.seek(3)
        assert source.read().calibration.depth.fx == 50.0
    assert "frame 10: the cameras change, to 32 x 24 with fx 25.0" in caplog.text


def test_depth_alone_is_gray_and_has_labels(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    for frame in scenes(5):
        bag.info("/cam/depth/camera_info", frame.timestamp_ns, DEPTH, CAMERA)
        bag.image("/gt/labels", frame.timestamp_ns, DEPTH, frame.labels, "16UC1")
        bag.image("/cam/depth/image_rect_raw", frame.timestamp_ns, DEPTH, frame.depth_mm, "16UC1")
        bag.image("/cam/infra1/image_rect_raw", frame.timestamp_ns, "infra1", frame.depth_mm, "mono16")
    with open_source(bag.close()) as source:
        again = list(source)
        assert len(again) == 5
        for one, other in zip(scenes(5), again, strict=True):
            np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
            np.testing.assert_array_equal(one.labels, other.labels)
            assert other.color.shape == (48, 64, 3)
            assert (other.color == 128).all()
            assert other.calibration.is_registered
        source.seek(3)
        assert source.read().index == 3


@pytest.mark.parametrize(
    "labels",
    [
        encoded(".png", np.zeros((4, 4), np.uint16)),
        encoded(".png", np.zeros((48, 64, 3), np.uint8)),
        b"\x89PNG\r\n\x1a\n and no more",
    ],
)
def test_labels_that_cannot_be_used_cost_only_themselves(tmp_path: Path, labels: bytes, caplog) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    for frame in scenes(4):
        content = labels if frame.index else encoded(".png", frame.labels)
        bag.compressed("/cam/labels", frame.timestamp_ns, COLOR, content, "mono16; png compressed")
        bag.camera("/cam", frame, CAMERA, frame.timestamp_ns)
    with open_source(bag.close()) as source:
        faults = [(frame.labels is None, source.labels_fault) for frame in source]
        assert faults[0] == (False, "")
        assert [lost for lost, _ in faults[1:]] == [True] * 3
        assert all(f"frame {n}: /cam/labels: " in fault for n, (_, fault) in enumerate(faults) if n)
        assert source.metadata["labels_lost"] == "3"
    assert caplog.text.count("frames whose labels cannot be used are replayed without them") == 1
