"""MCAP recordings of other programs: other topics, encodings and frames."""

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recorded_scene import APART, CAMERA, INTERVAL_NS, scene, scenes
from robot_bag import Bag, encoded

from nurbseg.common.frame import Intrinsics
from nurbseg.drivers import (
    CalibrationError,
    FrameFormatError,
    RecordingFormatError,
    RGBDFrame,
    SourceOptions,
    open_source,
)
from nurbseg.drivers.mcap import ros_messages as ros
from nurbseg.drivers.mcap.ros_messages import CAMERA_INFO, IMAGE, TRANSFORMS


def color_message(bag: Bag, frame: RGBDFrame, kind: str) -> None:
    topic, stamp, bgr = "/rgb/image", frame.timestamp_ns, frame.color[..., ::-1]
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    if kind == "bgr8":
        bag.image(topic, stamp, "optical", bgr, "bgr8")
    elif kind == "rgba8":
        bag.image(topic, stamp, "optical", np.dstack([frame.color, gray]), "rgba8")
    elif kind == "bgra8":
        bag.image(topic, stamp, "optical", np.dstack([bgr, gray]), "bgra8")
    elif kind == "mono8":
        bag.image(topic, stamp, "optical", gray, "mono8")
    elif kind == "png":
        bag.compressed(f"{topic}/compressed", stamp, "optical", encoded(".png", bgr), "png")
    else:
        bag.compressed(
            f"{topic}/compressed", stamp, "optical", encoded(".png", bgr), "rgb8; png compressed bgr8"
        )


def depth_message(bag: Bag, frame: RGBDFrame, kind: str) -> None:
    topic, stamp = "/depth/image", frame.timestamp_ns
    if kind == "16UC1":
        bag.image(topic, stamp, "optical", frame.depth_mm, "16UC1")
    elif kind == "mono16":
        bag.image(topic, stamp, "optical", frame.depth_mm, "mono16")
    elif kind == "32FC1":
        meters = np.where(frame.depth_mm > 0, frame.depth_mm * np.float32(1e-3), np.nan)
        bag.image(topic, stamp, "optical", meters.astype(np.float32), "32FC1")
    else:
        content = bytes(12) + encoded(".png", frame.depth_mm)
        bag.compressed(f"{topic}/compressedDepth", stamp, "optical", content, "16UC1; compressedDepth png")


@pytest.mark.parametrize("color", ["bgr8", "rgba8", "bgra8", "mono8", "png", "image_transport"])
@pytest.mark.parametrize("depth", ["16UC1", "mono16", "32FC1", "compressedDepth"])
def test_each_encoding_of_images_is_understood(tmp_path: Path, color: str, depth: str) -> None:
    frames = scenes(3)
    bag = Bag(tmp_path / "bag.mcap")
    for frame in frames:
        bag.info("/rgb/camera_info", frame.timestamp_ns, "optical", CAMERA)
        depth_message(bag, frame, depth)
        color_message(bag, frame, color)
    bag.close()
    with open_source(tmp_path / "bag.mcap") as source:
        assert source.calibration.is_registered
        assert source.calibration.depth.fx == CAMERA.fx
        again = list(source)
    assert len(again) == 3
    for one, other in zip(frames, again, strict=True):
        assert one.timestamp_ns == other.timestamp_ns
        np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
        expected = one.color
        if color == "mono8":
            expected = np.dstack([cv2.cvtColor(one.color, cv2.COLOR_RGB2GRAY)] * 3)
        np.testing.assert_array_equal(expected, other.color)


def write_apart(path: Path, *, transforms: bool = True) -> list[RGBDFrame]:
    """Two cameras on a tree of frames, as a robot's driver describes it, and other topics beside."""
    frames = scenes(3, APART)
    bag = Bag(path)
    start = frames[0].timestamp_ns
    link_from_depth, link_from_color = np.eye(4), np.eye(4)
    link_from_depth[:3, 3] = (0.1, 0.0, 0.02)
    link_from_color[:3] = (link_from_depth @ np.linalg.inv(APART.color_from_depth))[:3]
    if transforms:
        bag.add(
            "/tf_static",
            TRANSFORMS,
            ros.transform_message(start, "link", "depth", link_from_depth),
            start,
        )
        bag.add(
            "/tf_static",
            TRANSFORMS,
            ros.transform_message(start, "link", "color", link_from_color),
            start,
        )
    for frame in frames:
        stamp = frame.timestamp_ns
        bag.image("/cam/infra/image_rect", stamp, "infra", frame.depth_mm, "mono16")
        bag.image("/cam/infra/image_mono", stamp, "infra", (frame.depth_mm >> 8).astype(np.uint8), "mono8")
        bag.info("/cam/infra/camera_info", stamp, "infra", CAMERA)
        bag.info("/cam/depth/camera_info", stamp, "depth", APART.depth)
        bag.info("/cam/color/camera_info", stamp, "color", APART.color)
        bag.image("/cam/depth/image_rect_raw", stamp, "depth", frame.depth_mm, "16UC1")
        bag.image("/cam/color/image_raw", stamp, "color", frame.color, "rgb8")
    bag.close()
    return frames


def test_topics_are_chosen_and_the_transform_goes_by_way_of_other_frames(tmp_path: Path) -> None:
    frames = write_apart(tmp_path / "bag.mcap")
    with open_source(tmp_path / "bag.mcap") as source:
        np.testing.assert_allclose(source.calibration.color_from_depth, APART.color_from_depth, atol=1e-9)
        np.testing.assert_array_equal(source.calibration.color.matrix, APART.color.matrix)
        np.testing.assert_array_equal(source.calibration.depth.distortion, APART.depth.distortion)
        for one, other in zip(frames, source, strict=True):
            np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
            np.testing.assert_array_equal(one.color, other.color)


def test_cameras_apart_without_a_transform_are_an_error_that_names_both(tmp_path: Path) -> None:
    write_apart(tmp_path / "bag.mcap", transforms=False)
    with pytest.raises(CalibrationError, match=r"bag\.mcap: no transform from 'depth' to 'color'"):
        open_source(tmp_path / "bag.mcap")


def test_images_are_paired_by_their_stamps_and_the_lonely_are_counted(tmp_path: Path, caplog) -> None:
    frames = scenes(8)
    bag = Bag(tmp_path / "bag.mcap")
    rng = np.random.default_rng(0)
    for frame in frames:
        stamp = frame.timestamp_ns
        bag.info("/camera_info", stamp, "optical", CAMERA)
        if frame.index != 3:
            bag.image("/depth/image", stamp, "optical", frame.depth_mm, "16UC1")
        if frame.index not in (0, 5):
            late_ns = int(rng.integers(-9_000_000, 9_000_000))
            bag.image("/rgb/image", stamp + late_ns, "optical", frame.color, "rgb8")
    bag.close()
    options = SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))
    with caplog.at_level(logging.WARNING), open_source(tmp_path / "bag.mcap", options) as source:
        again = list(source)
        assert source.dropped == 3
        assert source.metadata["dropped"] == "3"
    assert "3 images had no partner" in caplog.text
    expected = [frames[index] for index in (1, 2, 4, 6, 7)]
    assert [frame.timestamp_ns for frame in again] == [frame.timestamp_ns for frame in expected]
    for one, other in zip(expected, again, strict=True):
        np.testing.assert_array_equal(one.color, other.color)


def test_images_too_far_apart_are_no_pair(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    for frame in scenes(4):
        stamp = frame.timestamp_ns
        bag.info("/rgb/camera_info", stamp, "optical", CAMERA)
        bag.image("/rgb/image", stamp + INTERVAL_NS // 2, "optical", frame.color, "rgb8")
        bag.image("/depth/image", stamp, "optical", frame.depth_mm, "16UC1")
    bag.close()
    with open_source(tmp_path / "bag.mcap", SourceOptions(association_limit_s=0.005)) as source:
        assert list(source) == []
    with open_source(tmp_path / "bag.mcap", SourceOptions(association_limit_s=0.02)) as source:
        assert len(list(source)) == 4


def test_padded_rows_and_the_other_byte_order_are_understood(tmp_path: Path) -> None:
    frame = scene(0)
    bag = Bag(tmp_path / "bag.mcap")
    bag.info("/rgb/camera_info", frame.timestamp_ns, "optical", CAMERA)
    bag.image("/rgb/image", frame.timestamp_ns, "optical", frame.color, "rgb8")
    message = ros.image_message(frame.timestamp_ns, "optical", frame.depth_mm, "16UC1")
    rows = np.zeros((48, 2 * 64 + 10), np.uint8)
    rows[:, :128] = frame.depth_mm.astype(">u2").view(np.uint8).reshape(48, 128)
    message |= {"is_bigendian": 1, "step": 138, "data": rows.tobytes()[:-10]}
    bag.add("/depth/image", IMAGE, message, frame.timestamp_ns)
    bag.close()
    with open_source(tmp_path / "bag.mcap") as source:
        np.testing.assert_array_equal(source.read().depth_mm, frame.depth_mm)


def test_one_bad_image_is_named_and_the_run_continues(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    for frame in scenes(4):
        stamp = frame.timestamp_ns
        bag.info("/rgb/camera_info", stamp, "optical", CAMERA)
        content = encoded(".jpg", frame.color[..., ::-1])
        bag.compressed(
            "/rgb/compressed", stamp, "optical", content[: -200 if frame.index == 1 else None], "jpeg"
        )
        message = ros.image_message(stamp, "optical", frame.depth_mm, "16UC1")
        if frame.index == 2:
            message["data"] = message["data"][:-1]
        bag.add("/depth/image", IMAGE, message, stamp)
    bag.close()
    with open_source(tmp_path / "bag.mcap") as source:
        assert source.read().index == 0
        with pytest.raises(
            FrameFormatError, match=r"bag\.mcap: frame 1: /rgb/compressed: the image is cut off"
        ):
            source.read()
        with pytest.raises(FrameFormatError, match="frame 2: /depth/image: data: the image is cut off"):
            source.read()
        assert source.read().index == 3


def test_images_that_change_their_size_are_refused_one_by_one(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    for frame in scenes(3):
        stamp = frame.timestamp_ns
        bag.info("/rgb/camera_info", stamp, "optical", CAMERA)
        bag.image("/rgb/image", stamp, "optical", frame.color, "rgb8")
        bag.image(
            "/depth/image", stamp, "optical", frame.depth_mm[: 24 if frame.index == 1 else None], "16UC1"
        )
    bag.close()
    with open_source(tmp_path / "bag.mcap") as source:
        source.read()
        with pytest.raises(
            FrameFormatError, match=r"frame 1: /rgb/camera_info: k: .*64x48 .* does not match .*64x24"
        ):
            source.read()
        assert source.read().index == 2


def lonely(path: Path, camera: Intrinsics | None, model: str = "plumb_bob", **values: Any) -> Path:
    frame = scene(0)
    bag = Bag(path)
    if camera is not None:
        message = ros.camera_info_message(frame.timestamp_ns, "optical", camera)
        bag.add("/rgb/camera_info", CAMERA_INFO, message | values | {"distortion_model": model}, 10)
    bag.image("/rgb/image", frame.timestamp_ns, "optical", frame.color, "rgb8")
    bag.image("/depth/image", frame.timestamp_ns, "optical", frame.depth_mm, "16UC1")
    bag.close()
    return path


def test_a_recording_without_calibration_says_which_flag_gives_one(tmp_path: Path) -> None:
    path = lonely(tmp_path / "bag.mcap", None)
    with pytest.raises(CalibrationError, match=r"bag\.mcap: no sensor_msgs/CameraInfo.*--intrinsics"):
        open_source(path)
    with open_source(path, SourceOptions(intrinsics=(52.5, 52.5, 31.5, 23.5))) as source:
        assert source.read().calibration.is_registered


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"k": [0.0] * 9, "p": [0.0] * 12}, "k: the camera is not calibrated.*--intrinsics"),
        ({"k": [float("nan")] + [0.0] * 7 + [1.0]}, "k: expected finite"),
        ({"d": [float("nan")] * 5}, "distortion: expected finite"),
        ({"d": [0.1, 0.2, 0.3]}, "distortion: expected .* coefficients, got 3"),
        ({"model": "equidistant", "d": [0.1, 0.0, 0.0, 0.0]}, "distortion_model: .*got 'equidistant'"),
    ],
)
def test_an_unusable_camera_info_is_an_error_that_names_the_topic_and_field(
    tmp_path: Path, values: dict[str, Any], text: str
) -> None:
    with pytest.raises(CalibrationError, match=rf"bag\.mcap: /rgb/camera_info.*{text}"):
        open_source(lonely(tmp_path / "bag.mcap", CAMERA, **values))


def test_a_recording_of_something_else_says_what_there_is(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    bag.image("/rgb/image", 10, "optical", scene(0).color, "rgb8")
    bag.close()
    with pytest.raises(RecordingFormatError, match=r"no topic of depth images.*/rgb/image \(Image rgb8\)"):
        open_source(tmp_path / "bag.mcap")


def test_labels_of_other_programs_are_found(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "bag.mcap")
    frame = scene(0)
    bag.info("/rgb/camera_info", frame.timestamp_ns, "optical", CAMERA)
    bag.image("/gt/labels", frame.timestamp_ns, "optical", frame.labels, "16UC1")
    bag.image("/rgb/image", frame.timestamp_ns, "optical", frame.color, "rgb8")
    bag.image("/depth/image", frame.timestamp_ns, "optical", frame.depth_mm, "16UC1")
    bag.close()
    with open_source(tmp_path / "bag.mcap") as source:
        np.testing.assert_array_equal(source.read().labels, frame.labels)


def test_a_folder_with_one_recording_is_that_recording(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    lonely(folder / "bag_0.mcap", CAMERA)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    with open_source(folder) as source:
        assert len(list(source)) == 1
    lonely(folder / "other.mcap", CAMERA)
    with pytest.raises(RecordingFormatError, match="2 recordings"):
        open_source(folder)
