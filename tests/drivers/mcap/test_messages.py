"""Images in ROS messages: every encoding, and what is refused or left out by name."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import Writer
from recorded_forms import QUANTIZATION, rvl
from recorded_scene import CAMERA, INTERVAL_NS, scene
from robot_bag import COLOR, DEPTH, INFO_TOPIC, TYPES, Bag, bag_of, encoded, image_values, packed, raw
from rosbags.typesys import get_types_from_msg

from nurbseg.drivers import FrameFormatError, RecordingFormatError, RGBDFrame, SourceOptions, open_source

FRAME = scene(0)
STAMP, DEPTH_MM = FRAME.timestamp_ns, FRAME.depth_mm
METERS = np.where(DEPTH_MM > 0, DEPTH_MM * np.float32(1e-3), np.float32(np.nan))
A, B = QUANTIZATION
QUANTIZED = np.where(DEPTH_MM > 0, np.rint(A / np.maximum(DEPTH_MM * 1e-3, 1e-3) + B), 0).astype(np.uint16)
COMPRESSED_DEPTH = f"{DEPTH}/compressedDepth"
PNG, GRAY = encoded(".png", DEPTH_MM), (DEPTH_MM >> 4).astype(np.uint8)


def read(path: Path, options: SourceOptions | None = None) -> tuple[list[RGBDFrame], Any]:
    with open_source(path, options) as source:
        return list(source), source


def nothing(bag: Bag) -> None:
    pass


def parameters(a: float = 0.0, b: float = 0.0) -> bytes:
    return struct.pack("<iff", 0, a, b)


PADDED = np.zeros((48, 138), np.uint8)
PADDED[:, :128] = DEPTH_MM.astype(">u2").view(np.uint8).reshape(48, 128)
DEPTHS = [
    raw(DEPTH, DEPTH_MM, "mono16"),
    raw(DEPTH, DEPTH_MM, "16UC1", is_bigendian=1, step=138, data=PADDED.tobytes()[:-10]),
    packed(f"{DEPTH}/compressed", encoded(".tiff", METERS), "32FC1; tiff compressed "),
    packed(f"{DEPTH}/compressed", PNG, "png"),
    packed(f"{DEPTH}/compressed", PNG, "16UC1; png compressed "),
    # Without the header of the plugin, which for 16 bits leaves the parameters as they were in memory.
    packed(COMPRESSED_DEPTH, PNG, "16UC1; compressedDepth png"),
    packed(COMPRESSED_DEPTH, parameters(A, B) + PNG, "16UC1; compressedDepth png"),
    # RealSense's own recordings, and old ones that name no type.
    packed(COMPRESSED_DEPTH, parameters() + PNG, "; compressedDepth"),
    packed(COMPRESSED_DEPTH, parameters() + PNG, "32FC1; compressedDepth png"),
    packed(COMPRESSED_DEPTH, parameters() + PNG, "png"),
    packed(COMPRESSED_DEPTH, parameters(A, B) + encoded(".png", QUANTIZED), "32FC1; compressedDepth png"),
    packed(COMPRESSED_DEPTH, parameters(A, B) + rvl(QUANTIZED), "32FC1; compressedDepth rvl"),
    packed(COMPRESSED_DEPTH, parameters(A, B) + encoded(".png", QUANTIZED), "; compressedDepth png"),
]


@pytest.mark.parametrize("place", range(len(DEPTHS)))
def test_each_encoding_of_depth_is_read(tmp_path: Path, place: int) -> None:
    (frame,), _ = read(bag_of(tmp_path, DEPTHS[place]))
    np.testing.assert_array_equal(frame.depth_mm == 0, DEPTH_MM == 0)
    # A step of the quantization is depth squared over a.
    most = 1000 * 2.1**2 / A + 1 if place >= len(DEPTHS) - 3 else 0
    assert np.abs(frame.depth_mm - DEPTH_MM.astype(float)).max() <= most


def test_any_image_comes_back_from_rvl_and_damage_is_a_typed_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    bag, images = Bag(tmp_path / "a.mcap"), []
    bag.info(INFO_TOPIC, STAMP, "c", CAMERA)
    for number in range(200):
        images.append(rng.integers(0, 65_535, (48, 64)).astype(np.uint16))
        images[-1][rng.random((48, 64)) < min(number, 4) / 4] = 0
        content = bytearray(rvl(images[-1]))
        for place in rng.integers(8, len(content), 5 if number >= 5 else 0):
            content[place] = rng.integers(256)
        form = "16UC1; compressedDepth rvl"
        stamp = STAMP + number * INTERVAL_NS
        bag.compressed(COMPRESSED_DEPTH, stamp, "c", parameters() + content, form)
    frames, source = read(bag.close())
    assert len(frames) + int(source.metadata["damaged"]) == 200 > len(frames)
    for image, frame in zip(images[:5], frames, strict=False):
        np.testing.assert_array_equal(frame.depth_mm, image)


#: One color, as cameras' drivers publish it.
PLAIN = np.full((48, 64, 3), (200, 60, 120), np.uint8)


def mosaic(pattern: str) -> np.ndarray:
    found = np.zeros((48, 64), np.uint8)
    for place, letter in enumerate(pattern):
        found[place // 2 :: 2, place % 2 :: 2] = PLAIN[0, 0, "rgb".index(letter)]
    return found


def yuv(encoding: str) -> np.ndarray:
    """Return Y and U or V of ITU-R BT.601 with limited range, packed."""
    r, g, b = PLAIN[0, 0].astype(float)
    y = 16 + (65.481 * r + 128.553 * g + 24.966 * b) / 255
    u = 128 + (-37.797 * r - 74.203 * g + 112.0 * b) / 255
    v = 128 + (112.0 * r - 93.786 * g - 18.214 * b) / 255
    chroma = np.tile(np.where(np.arange(64) % 2 == 0, u, v), (48, 1))
    planes = [np.full((48, 64), y), chroma]
    is_y_first = encoding in ("yuyv", "yuv422_yuy2")
    return np.rint(np.dstack(planes if is_y_first else planes[::-1])).astype(np.uint8)


def half_planar(encoding: str) -> np.ndarray:
    """Return rows of brightness, and half as many of color below."""
    planes = cv2.cvtColor(PLAIN, cv2.COLOR_RGB2YUV_I420)
    u, v = planes[48:].reshape(2, 24, 32)
    return np.vstack([planes[:48], np.dstack([u, v] if encoding == "nv12" else [v, u]).reshape(24, 64)])


RGB, BGR = FRAME.color, FRAME.color[..., ::-1]
LUMA = cv2.cvtColor(RGB, cv2.COLOR_RGB2GRAY)
PATTERNS = ("rggb", "bggr", "gbrg", "grbg")
#: How color is written, the color that is expected, and the largest difference.
COLORS: list[tuple[Callable[[Bag], None], np.ndarray, int]] = [
    (raw(COLOR, BGR, "bgr8"), RGB, 0),
    (raw(COLOR, np.dstack([RGB, LUMA]), "rgba8"), RGB, 0),
    (raw(COLOR, np.dstack([BGR, LUMA]), "bgra8"), RGB, 0),
    (raw(COLOR, np.dstack([BGR, LUMA]), "8UC4"), RGB, 0),
    (raw(COLOR, LUMA, "mono8"), np.dstack([LUMA] * 3), 0),
    (raw(COLOR, RGB.astype(np.uint16) * 257, "rgb16"), RGB, 0),
    (raw(COLOR, BGR.astype(np.uint16) * 257, "bgr16"), RGB, 0),
    (packed(f"{COLOR}/compressed", encoded(".png", BGR), "png"), RGB, 0),
    (packed(f"{COLOR}/compressed", encoded(".png", BGR), "rgb8; png compressed bgr8"), RGB, 0),
    (packed(f"{COLOR}/compressed", encoded(".jpg", PLAIN[..., ::-1]), ""), PLAIN, 3),
    *((raw(COLOR, mosaic(pattern), f"bayer_{pattern}8"), PLAIN, 0) for pattern in PATTERNS),
    *((raw(COLOR, yuv(name), name), PLAIN, 2) for name in ("yuyv", "yuv422_yuy2", "uyvy", "yuv422")),
    *((raw(COLOR, half_planar(name), name, height=48), PLAIN, 3) for name in ("nv12", "nv21")),
    *(
        (packed(f"{COLOR}/compressed", encoded(".png", stored), f"bayer_{pattern}8; png compressed {form}"),
         PLAIN, 0)
        for pattern in PATTERNS
        for form, stored in (("", mosaic(pattern)), ("mono8", mosaic(pattern)), ("bgr8", PLAIN[..., ::-1]))
    ),
]  # fmt: skip


@pytest.mark.parametrize("place", range(len(COLORS)))
def test_each_encoding_of_color_is_read(tmp_path: Path, place: int, caplog) -> None:
    write, expected, most = COLORS[place]
    (frame,), _ = read(bag_of(tmp_path, None, write))
    assert np.abs(frame.color.astype(int) - expected).max() <= most
    assert not caplog.messages


TYPES.register(get_types_from_msg("sensor_msgs/Image rgb\nsensor_msgs/Image depth\n", "a_msgs/msg/RGBD"))
BOTH = {
    "rgb": image_values(STAMP, "c", FRAME.color, "rgb8"),
    "depth": image_values(STAMP, "c", DEPTH_MM, "16UC1"),
}


def zeros(field: str, size: int) -> Callable[[Bag], None]:
    return lambda bag: bag.info("/d/camera_info", STAMP, "d", CAMERA, **{field: np.zeros(size)})


SHOWN = "8 bits or JPEG do not keep depth"
#: What stands in place of depth, and what is said when it is opened.
NO_DEPTH: list[tuple[Callable[[Bag], None], str]] = [
    (nothing, r"no topic of depth images.*/c/rgb/image \(Image rgb8\)"),
    (raw(DEPTH, GRAY, "8UC1"), f"{DEPTH}: {SHOWN}"),
    (packed(f"{DEPTH}/compressed", encoded(".jpg", GRAY), "16UC1; jpeg compressed "), f"compressed: {SHOWN}"),
    (packed(f"{DEPTH}/compressed", encoded(".jpg", GRAY), "mono8; jpeg compressed"), f"compressed: {SHOWN}"),
    (
        lambda bag: bag.add("/c/both", "a_msgs/msg/RGBD", BOTH, STAMP),
        "no topic of .*; not read: a_msgs/msg/RGBD",
    ),
    *(
        (raw(topic, METERS, "32FC1"), f"{topic}: by its name the distance along each")
        for topic in ("/airsim_node/a/front/DepthPerspective", "/ifm3d/radial_distance")
    ),
]


@pytest.mark.parametrize(("depth", "said"), NO_DEPTH)
def test_a_recording_without_depth_says_what_there_is(tmp_path: Path, depth, said: str) -> None:
    with pytest.raises(RecordingFormatError, match=rf"a\.mcap: .*{said}"):
        open_source(bag_of(tmp_path, depth))


#: Names of images of depth's encoding, and what is said of them without --depth-topic and with it.
BY_ANOTHER_NAME = [
    *((topic, "not depth by the name, but --depth-topic", "") for topic in (
        "/c/ir/image", "/c/confidence/map", "/oak/stereo/image_raw", "/depth_camera/infra1/image")),
    ("/s/distance_to_camera", "distance along each", "distance along each"),
    ("/airsim_node/a/front/DepthPlanar", "", ""),
]  # fmt: skip


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "mono16"])
@pytest.mark.parametrize(("topic", "said", "said_on_request"), BY_ANOTHER_NAME)
def test_images_of_depths_encoding_but_another_name_are_read_on_request(
    tmp_path: Path, topic: str, said: str, said_on_request: str, encoding: str
) -> None:
    path = bag_of(tmp_path, raw(topic, METERS if encoding == "32FC1" else DEPTH_MM, encoding))
    for options, text in ((None, said), (SourceOptions(depth_topic=topic), said_on_request)):
        if text:
            with pytest.raises(RecordingFormatError, match=f"{topic}: .*{text}"):
                open_source(path, options)
        else:
            (frame,), _ = read(path, options)
            np.testing.assert_array_equal(frame.depth_mm, DEPTH_MM)


CONTENT = rvl(DEPTH_MM)
RVL_FORM = "16UC1; compressedDepth rvl"


def depth_of(content: bytes, form: str = "16UC1; compressedDepth") -> Callable[[Bag], None]:
    return packed(COMPRESSED_DEPTH, content, form)


#: Depth of one frame that costs it, and what is said of it.
BAD_DEPTH: list[tuple[Callable[[Bag], None], str]] = [
    (depth_of(bytes(5)), "cut off after 5 bytes"),
    (depth_of(parameters() + b"\xff\xd8\xff\xe0 a JPEG"), "PNG or RVL"),
    (depth_of(parameters() + encoded(".png", GRAY)), "got 1 of 8 bits"),
    (depth_of(parameters(-1, 2) + PNG, "32FC1; compressedDepth"), "finite quantization .*a = -1"),
    (depth_of(parameters(np.nan, 2) + PNG, "32FC1; compressedDepth"), "got a = nan"),
    *(
        (depth_of(parameters() + CONTENT[:length], RVL_FORM), "the RVL image is|cut off after")
        for length in (0, 7, 8, 12, len(CONTENT) // 2, len(CONTENT) - 8)
    ),
    *(
        (depth_of(parameters() + struct.pack("<II", *size) + CONTENT[8:], RVL_FORM), "width, height")
        for size in ((0, 4), (1 << 20, 1 << 20), (0xFFFFFFFF, 0xFFFFFFFF))
    ),
    # A run of more pixels than there are, and a number of more half bytes than one has.
    *(
        (depth_of(parameters() + struct.pack(f"<{len(words)}I", *words), RVL_FORM), "at pixel 0 of 4")
        for words in ([2, 2, 0x7FFFFFFF], [2, 2, *[0xFFFFFFFF] * 9])
    ),
    (raw(DEPTH, DEPTH_MM[:0], "16UC1"), "width, height: the image has no pixels"),
    (raw(DEPTH, DEPTH_MM, "16UC1", data=DEPTH_MM.tobytes()[:-1]), "data: the image is cut off"),
    (raw(DEPTH, DEPTH_MM[:24], "16UC1"), r"camera_info: k: .*64x48 .* does not match .*64x24"),
]


@pytest.mark.parametrize("place", range(len(BAD_DEPTH)))
def test_one_bad_image_is_named_and_the_run_continues(tmp_path: Path, place: int) -> None:
    write, said = BAD_DEPTH[place]
    bag = Bag(tmp_path / "a.mcap")
    topics: list[str] = []
    # The same topic as the bad one's, by a bag that only listens.
    listener = Bag(tmp_path / "b.mcap")
    listener.write = lambda topic, *_: topics.append(topic)  # type: ignore[method-assign]
    write(listener)
    for index in range(3):
        stamp = STAMP + (index - 1) * INTERVAL_NS
        bag.info(INFO_TOPIC, stamp, "c", CAMERA)
        bag.image(COLOR, stamp, "c", FRAME.color, "rgb8")
        if index == 1:
            write(bag)
        elif topics[0] == DEPTH:
            bag.image(DEPTH, stamp, "c", DEPTH_MM, "16UC1")
        else:
            bag.compressed(COMPRESSED_DEPTH, stamp, "c", parameters() + PNG, "16UC1; compressedDepth")
    listener.close()
    with open_source(bag.close()) as source:
        assert source.read().index == 0
        with pytest.raises(FrameFormatError, match=rf"a\.mcap: frame 1: .*({said})"):
            source.read()
        assert source.read().index == 2


@pytest.mark.parametrize(
    ("color", "said"),
    [
        (packed(f"{COLOR}/compressed", b"\0\0\0\1\x67" + bytes(99), "h264"), "CompressedImage h264"),
        (raw(COLOR, LUMA, "yuv420"), "Image yuv420"),
        # Depth for people.
        (raw(f"{DEPTH}_shown", LUMA, "mono8"), f"{DEPTH}_shown (Image mono8)"),
    ],
)
def test_color_that_is_not_read_is_named_and_gray(tmp_path: Path, color, said: str, caplog) -> None:
    (frame,), _ = read(bag_of(tmp_path, None, color))
    assert (frame.color == 128).all()
    assert "gray instead; not read: /c/" in caplog.text and said in caplog.text


@pytest.mark.parametrize(
    ("profile", "schema", "coding", "encoding", "text"),
    [
        ("ros1", "sensor_msgs/Image", "ros1msg", "ros1", r"sensor_msgs/Image \(ros1\); .*rosbags-convert"),
        ("", "foxglove.RawImage", "protobuf", "protobuf", r"foxglove.RawImage \(protobuf\); .* in cdr"),
        ("", "foxglove.CompressedImage", "jsonschema", "json", r"\(json\); record sensor_msgs"),
        ("", "sensor_msgs/msg/PointCloud2", "ros2msg", "cdr", r"PointCloud2 \(cdr\); record the depth"),
    ],
)
def test_messages_of_others_are_named(tmp_path, profile, schema, coding, encoding, text):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile)
        number = writer.register_schema(schema, coding, b"Header header")
        channel = writer.register_channel("/camera/depth/image_raw", encoding, number)
        writer.add_message(channel, 1, bytes(100), 1)
        writer.finish()
    with pytest.raises(RecordingFormatError, match=rf"a\.mcap: no topic of depth images.*{text}"):
        open_source(path)


def test_a_unit_that_a_realsense_states_is_used(tmp_path: Path) -> None:
    option = "/device_0/sensor_0/option/Depth_Units/value"

    def depth(bag: Bag) -> None:
        bag.add(option, "std_msgs/msg/Float32", {"data": 0.00025}, STAMP)
        bag.image(DEPTH, STAMP, "c", DEPTH_MM * 4, "16UC1")

    path = bag_of(tmp_path, depth)
    for scale, factor, said in (
        (None, 1, f"4000 per meter ({option}"),
        (1000.0, 4, "1000 per meter (--depth"),
    ):
        (frame,), source = read(path, SourceOptions(depth_scale=scale))
        assert str(source.depth_unit).startswith(said)
        np.testing.assert_array_equal(frame.depth_mm, DEPTH_MM * factor)
