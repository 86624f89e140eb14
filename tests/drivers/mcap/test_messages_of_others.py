"""Messages as other programs log them, in bags that rosbags writes."""

import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recorded_scene import CAMERA, RGBDFrame, scene, scenes
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nurbseg.drivers import RecordingFormatError, open_source

TYPES = get_typestore(Stores.ROS2_HUMBLE)
IMAGE, COMPRESSED, INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
START_NS = 1_700_000_000_000_000_000
FRAME = scene(0)
DEPTH, COLOR = "/camera/depth/image", "/camera/color/image"


def header(stamp_ns: int) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = TYPES.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return TYPES.types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")


def image(frame: RGBDFrame, pixels: np.ndarray, encoding: str, height: int = 0) -> tuple[str, Any]:
    message = TYPES.types[IMAGE](
        header=header(frame.timestamp_ns),
        height=height or pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=np.frombuffer(pixels.tobytes(), np.uint8),
    )
    return IMAGE, message


def compressed(frame: RGBDFrame, content: bytes, form: str) -> tuple[str, Any]:
    data = np.frombuffer(content, np.uint8)
    return COMPRESSED, TYPES.types[COMPRESSED](header=header(frame.timestamp_ns), format=form, data=data)


def info(frame: RGBDFrame) -> tuple[str, Any]:
    region = TYPES.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    message = TYPES.types[INFO](
        header=header(frame.timestamp_ns),
        height=48,
        width=64,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=CAMERA.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([CAMERA.matrix, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )
    return INFO, message


def bag(
    folder: Path, depth, color, *, plugin=StoragePlugin.MCAP, mode: CompressionMode | None = None
) -> Path:
    """Write three frames; `depth` and `color` make the messages of each."""
    writer = Writer(folder / "bag", version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for frame in scenes(3):
            for topic, make in ((DEPTH, depth), (COLOR, color), ("/camera/camera_info", info)):
                kind, message = make(frame)
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
                content = TYPES.serialize_cdr(message, kind)
                writer.write(connections[topic], frame.timestamp_ns + 1_000_000, content)
    return folder / "bag"


def plain_depth(frame: RGBDFrame) -> tuple[str, Any]:
    return image(frame, frame.depth_mm, "16UC1")


def plain_color(frame: RGBDFrame) -> tuple[str, Any]:
    return image(frame, frame.color, "rgb8")


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


@pytest.mark.parametrize("rows", [1, 48])
def test_what_to_do_with_clouds_alone_is_said(tmp_path: Path, rows: int) -> None:
    def cloud(frame: RGBDFrame) -> tuple[str, Any]:
        points = np.zeros((rows, 64, 4), "<f4")
        fields = [
            TYPES.types["sensor_msgs/msg/PointField"](name=name, offset=4 * place, datatype=7, count=1)
            for place, name in enumerate("xyz")
        ]
        message = TYPES.types["sensor_msgs/msg/PointCloud2"](
            header=header(frame.timestamp_ns),
            height=rows,
            width=64,
            fields=fields,
            is_bigendian=False,
            point_step=16,
            row_step=16 * 64,
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=False,
        )
        return "sensor_msgs/msg/PointCloud2", message

    with pytest.raises(RecordingFormatError, match=r"its point clouds are not read; .* write PCD files by"):
        open_source(bag(tmp_path, cloud, plain_color))


def test_messages_of_unknown_types_are_named(tmp_path: Path) -> None:
    TYPES.register(get_types_from_msg("sensor_msgs/Image rgb\nsensor_msgs/Image depth\n", "a_msgs/msg/RGBD"))

    def both(frame: RGBDFrame) -> tuple[str, Any]:
        images = {"rgb": plain_color(frame)[1], "depth": plain_depth(frame)[1]}
        return "a_msgs/msg/RGBD", TYPES.types["a_msgs/msg/RGBD"](**images)

    with pytest.raises(RecordingFormatError, match=r"no topic of depth images .*; not read: a_msgs/msg/RGBD"):
        open_source(bag(tmp_path, both, plain_color))
