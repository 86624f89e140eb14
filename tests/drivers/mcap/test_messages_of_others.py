"""Messages as other programs log them, in bags that rosbags writes."""

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from logged_messages import COLOR, DEPTH, TYPES, bag, compressed, image, plain_color, plain_depth
from recorded_scene import RGBDFrame, scenes
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import get_types_from_msg

from nurbseg.drivers import RecordingFormatError, open_source


def read(path: Path) -> list[RGBDFrame]:
    with open_source(path) as source:
        frames = list(source)
    # Iteration passes over those that are damaged.
    assert len(frames) == 3
    return frames


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_messages_that_are_compressed_one_by_one_are_read(tmp_path: Path, plugin: StoragePlugin) -> None:
    frames = read(bag(tmp_path, plain_depth, plain_color, plugin=plugin, mode=CompressionMode.MESSAGE))
    for frame, expected in zip(frames, scenes(3), strict=True):
        np.testing.assert_array_equal(frame.depth_mm, expected.depth_mm)
        np.testing.assert_array_equal(frame.color, expected.color)


def half_planar(encoding: str):
    """Return what makes images whose rows of color, half as many, are below those of brightness."""

    def make(frame: RGBDFrame) -> tuple[str, Any]:
        planes = cv2.cvtColor(np.full_like(frame.color, (200, 60, 120)), cv2.COLOR_RGB2YUV_I420)
        u, v = planes[48:].reshape(2, 24, 32)
        below = np.dstack([u, v] if encoding == "nv12" else [v, u]).reshape(24, 64)
        return image(frame, np.vstack([planes[:48], below]), encoding, height=48)

    return make


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_half_as_much_color_as_brightness_is_read(tmp_path: Path, encoding: str) -> None:
    for frame in read(bag(tmp_path, plain_depth, half_planar(encoding))):
        assert np.abs(frame.color.astype(int) - (200, 60, 120)).max() <= 3


@pytest.mark.parametrize(("form", "is_mosaic"), [("", True), ("mono8", True), ("bgr8", False)])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_compressed_mosaic_becomes_color(tmp_path: Path, pattern: str, form: str, is_mosaic: bool) -> None:
    pixels = np.full((48, 64, 3), (200, 60, 120), np.uint8)
    mosaic = np.zeros((48, 64), np.uint8)
    for place, letter in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = pixels[0, 0, "rgb".index(letter)]
    stored = mosaic if is_mosaic else pixels[..., ::-1]
    content = cv2.imencode(".png", stored)[1].tobytes()
    form = f"bayer_{pattern}8; png compressed {form}"
    for frame in read(bag(tmp_path, plain_depth, lambda frame: compressed(frame, content, form))):
        np.testing.assert_array_equal(frame.color, pixels)


def test_floating_point_depth_may_be_a_compressed_tiff(tmp_path: Path) -> None:
    def depth(frame: RGBDFrame) -> tuple[str, Any]:
        content = cv2.imencode(".tiff", (frame.depth_mm / 1000).astype(np.float32))[1].tobytes()
        return compressed(frame, content, "32FC1; tiff compressed ")

    for frame, expected in zip(read(bag(tmp_path, depth, plain_color)), scenes(3), strict=True):
        np.testing.assert_array_equal(frame.depth_mm, expected.depth_mm)


def test_a_jpeg_whose_format_is_not_stated_is_color(tmp_path: Path) -> None:
    content = cv2.imencode(".jpg", np.full((48, 64, 3), (120, 60, 200), np.uint8))[1].tobytes()
    for frame in read(bag(tmp_path, plain_depth, lambda frame: compressed(frame, content, ""))):
        assert np.abs(frame.color.astype(int) - (200, 60, 120)).max() <= 3


@pytest.mark.parametrize(
    ("color", "said"),
    [
        (lambda frame: compressed(frame, b"\0\0\0\1\x67" + bytes(99), "h264"), "CompressedImage h264"),
        (lambda frame: image(frame, frame.color[..., 0], "yuv420"), "Image yuv420"),
    ],
)
def test_color_that_is_not_read_is_named(tmp_path: Path, color, said: str, caplog) -> None:
    with caplog.at_level(logging.WARNING):
        frames = read(bag(tmp_path, plain_depth, color))
    assert len(frames) == 3
    assert f"gray instead; not read: {COLOR} ({said})" in caplog.text


def test_an_image_without_pixels_is_said_to_have_none(tmp_path: Path) -> None:
    def nothing(frame: RGBDFrame) -> tuple[str, Any]:
        return image(frame, frame.depth_mm[:0], "16UC1")

    said = f"frame 0: {DEPTH}: width, height: the image has no pixels"
    with open_source(bag(tmp_path, nothing, plain_color)) as source, pytest.raises(ValueError, match=said):
        source.read()


def test_messages_of_unknown_types_are_named(tmp_path: Path) -> None:
    TYPES.register(get_types_from_msg("sensor_msgs/Image rgb\nsensor_msgs/Image depth\n", "a_msgs/msg/RGBD"))

    def both(frame: RGBDFrame) -> tuple[str, Any]:
        images = {"rgb": plain_color(frame)[1], "depth": plain_depth(frame)[1]}
        return "a_msgs/msg/RGBD", TYPES.types["a_msgs/msg/RGBD"](**images)

    with pytest.raises(RecordingFormatError, match=r"no topic of depth images .*; not read: a_msgs/msg/RGBD"):
        open_source(bag(tmp_path, both, plain_color))
