"""Depth that image_transport compressed: quantized, plain, and by the RVL codec."""

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap_ros2.writer import Writer
from recorded_scene import CAMERA, scene
from robot_bag import Bag, encoded

from nurbseg.drivers import FrameFormatError, RecordingFormatError, RGBDFrame, SourceOptions, open_source
from nurbseg.drivers.mcap.decoding.images import decode_compressed_depth
from nurbseg.drivers.mcap.decoding.rvl import decode_rvl
from nurbseg.drivers.mcap.ros_messages import (
    CAMERA_INFO,
    DEFINITIONS,
    IMAGE,
    camera_info_message,
    image_message,
)

#: As the plugin computes them for a depth quantization of 100 and at most 10 m.
A = 100.0 * 101.0
B = 1.0 - A / 10.0
DEPTH = np.array([[0, 500, 501, 65_535], [900, 0, 0, 12_345]], np.uint16)


def header(a: float = 0.0, b: float = 0.0) -> bytes:
    return struct.pack("<iff", 0, a, b)


def rvl(image: np.ndarray) -> bytes:
    """Encode an image: runs of zeros and of others in turn, each number three bits to half a byte."""
    halves: list[int] = []

    def put(number: int) -> None:
        while True:
            halves.append(number & 7 | (8 if number > 7 else 0))
            number >>= 3
            if not number:
                return

    values = image.ravel().astype(int).tolist()
    place = before = 0
    while place < len(values):
        for zeros in (True, False):
            start = place
            while place < len(values) and (values[place] == 0) == zeros:
                place += 1
            put(place - start)
            if not zeros:
                for value in values[start:place]:
                    step = value - before
                    put(2 * step if step >= 0 else -2 * step - 1)
                    before = value
    halves += [0] * (-len(halves) % 8)
    words = [int("".join(f"{half:x}" for half in halves[n : n + 8]), 16) for n in range(0, len(halves), 8)]
    height, width = image.shape
    return struct.pack("<ii", width, height) + struct.pack(f"<{len(words)}I", *words)


def replayed(
    path: Path, content: bytes, form: str, topic: str = "/d/depth/image/compressedDepth"
) -> RGBDFrame:
    frame = scene(0)
    bag = Bag(path)
    bag.info("/d/depth/camera_info", frame.timestamp_ns, "optical", CAMERA)
    bag.compressed(topic, frame.timestamp_ns, "optical", content, form)
    bag.image("/d/rgb/image", frame.timestamp_ns, "optical", frame.color, "rgb8")
    bag.close()
    with open_source(path) as source:
        return source.read()


@pytest.mark.parametrize("codec", ["png", "rvl"])
@pytest.mark.parametrize("form", ["32FC1; compressedDepth {}", "; compressedDepth {}"])
def test_quantized_inverse_depth_is_metres(tmp_path: Path, codec: str, form: str) -> None:
    frame = scene(0)
    meters = frame.depth_mm * 1e-3
    values = np.where(meters > 0, np.rint(A / np.maximum(meters, 1e-3) + B), 0).astype(np.uint16)
    content = header(A, B) + (encoded(".png", values) if codec == "png" else rvl(values))
    again = replayed(tmp_path / "bag.mcap", content, form.format(codec))
    np.testing.assert_array_equal(again.depth_mm == 0, frame.depth_mm == 0)
    # A step of the quantization is depth squared over a.
    assert np.abs(again.depth_mm - frame.depth_mm.astype(float)).max() < 1000 * 2.1**2 / A + 1


@pytest.mark.parametrize(
    ("form", "parameters"),
    [
        # What the plugin writes for 16 bits leaves the parameters as they were in memory.
        ("16UC1; compressedDepth", (3.1e-38, 7.5)),
        ("16UC1; compressedDepth png", (A, B)),
        ("16UC1; compressedDepth rvl", (0.0, 0.0)),
        # RealSense's own recordings, and old ones that name no type.
        ("; compressedDepth", (0.0, 0.0)),
        ("32FC1; compressedDepth png", (0.0, 0.0)),
        ("png", (0.0, 0.0)),
    ],
)
def test_depth_of_16_bits_is_plain_millimeters(
    tmp_path: Path, form: str, parameters: tuple[float, float]
) -> None:
    frame = scene(0)
    image = rvl(frame.depth_mm) if "rvl" in form else encoded(".png", frame.depth_mm)
    again = replayed(tmp_path / "bag.mcap", header(*parameters) + image, form)
    np.testing.assert_array_equal(again.depth_mm, frame.depth_mm)


def test_a_png_without_the_header_is_found(tmp_path: Path) -> None:
    content = encoded(".png", scene(0).depth_mm)
    again = replayed(tmp_path / "bag.mcap", content, "16UC1; compressedDepth png")
    np.testing.assert_array_equal(again.depth_mm, scene(0).depth_mm)
    again = replayed(tmp_path / "b.mcap", content, "16UC1; png compressed ", "/d/depth/image/compressed")
    np.testing.assert_array_equal(again.depth_mm, scene(0).depth_mm)


@pytest.mark.parametrize("seed", range(5))
def test_any_image_comes_back_from_rvl(seed: int) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 65_536, (37, 53)).astype(np.uint16)
    image[rng.random(image.shape) < seed / 5] = 0
    np.testing.assert_array_equal(decode_rvl(rvl(image), "a"), image)
    np.testing.assert_array_equal(decode_rvl(rvl(DEPTH), "a"), DEPTH)
    assert not decode_rvl(rvl(np.zeros((4, 4), np.uint16)), "a").any()


def test_rvl_that_is_cut_off_damaged_or_too_large_is_a_typed_error() -> None:
    content = rvl(scene(0).depth_mm)
    for length in (0, 7, 8, 12, len(content) // 2, len(content) - 8):
        with pytest.raises(FrameFormatError, match="a: the RVL image is"):
            decode_rvl(content[:length], "a")
    for width, height in ((0, 4), (1 << 20, 1 << 20), (0xFFFFFFFF, 0xFFFFFFFF)):
        with pytest.raises(FrameFormatError, match="a: width, height: expected 1 to"):
            decode_rvl(struct.pack("<II", width, height) + content[8:], "a")
    rng = np.random.default_rng(0)
    for _ in range(200):
        changed = bytearray(content)
        for place in rng.integers(8, len(content), 5):
            changed[place] = rng.integers(256)
        try:
            assert decode_rvl(bytes(changed), "a").shape == (48, 64)
        except FrameFormatError:
            continue
    # A run of more pixels than there are, and a number of more half bytes than one has.
    for words in ([0x7FFFFFFF], [0xFFFFFFFF] * 9):
        with pytest.raises(FrameFormatError, match="damaged at pixel 0 of 4"):
            decode_rvl(struct.pack(f"<II{len(words)}I", 2, 2, *words), "a")


@pytest.mark.parametrize(
    ("content", "form", "text"),
    [
        (bytes(5), "16UC1; compressedDepth", "cut off after 5 bytes"),
        (header() + b"\xff\xd8\xff\xe0 a JPEG", "16UC1; compressedDepth", "expected depth as PNG or RVL"),
        (header() + encoded(".png", np.zeros((4, 4), np.uint8)), "16UC1; compressedDepth", "got 1 of 8 bits"),
        (
            header(-1, 2) + encoded(".png", DEPTH),
            "32FC1; compressedDepth",
            "finite quantization .*got a = -1",
        ),
        (header(np.nan, 2) + encoded(".png", DEPTH), "32FC1; compressedDepth", "got a = nan"),
    ],
)
def test_what_is_no_compressed_depth_is_refused_by_name(content: bytes, form: str, text: str) -> None:
    with pytest.raises(FrameFormatError, match=text):
        decode_compressed_depth(content, form, "a")


def test_depth_of_8_bits_or_jpeg_is_refused_by_name(tmp_path: Path) -> None:
    frame = scene(0)
    gray = (frame.depth_mm >> 4).astype(np.uint8)
    for name, form in (("jpeg", "16UC1; jpeg compressed "), ("mono", "mono8; jpeg compressed")):
        with pytest.raises(
            RecordingFormatError, match="/d/depth/image/compressed: 8 bits or JPEG do not keep"
        ):
            replayed(tmp_path / f"{name}.mcap", encoded(".jpg", gray), form, "/d/depth/image/compressed")
    bag = Bag(tmp_path / "raw.mcap")
    bag.image("/d/depth/image", 10, "optical", gray, "8UC1")
    bag.image("/d/rgb/image", 10, "optical", frame.color, "rgb8")
    with pytest.raises(RecordingFormatError, match="/d/depth/image: 8 bits or JPEG do not keep depth"):
        open_source(bag.close())


def test_the_unit_is_said_with_its_reason_and_the_user_counts_first(tmp_path: Path) -> None:
    frame = scene(0)
    bag = Bag(tmp_path / "bag.mcap")
    bag.info("/d/depth/camera_info", frame.timestamp_ns, "optical", CAMERA)
    bag.image(
        "/d/depth/image", frame.timestamp_ns, "optical", (frame.depth_mm * 1e-3).astype(np.float32), "32FC1"
    )
    path = bag.close()
    with open_source(path) as source:
        assert (
            str(source.depth_unit)
            == source.metadata["depth_unit"]
            == "1 per meter (ROS REP 118: 32FC1 is in meters)"
        )
        np.testing.assert_array_equal(source.read().depth_mm, frame.depth_mm)
    with open_source(path, SourceOptions(depth_scale=2.0)) as source:
        assert str(source.depth_unit).startswith("2 per meter (--depth-scale")
        assert np.abs(source.read().depth_mm - frame.depth_mm / 2).max() <= 0.5


def test_a_unit_that_a_realsense_states_is_used(tmp_path: Path) -> None:
    frame, stamp = scene(0), scene(0).timestamp_ns
    path = tmp_path / "bag.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        schemas = {name: writer.register_msgdef(name, text) for name, text in DEFINITIONS.items()}
        schemas["unit"] = writer.register_msgdef("std_msgs/msg/Float32", "float32 data\n")
        message = camera_info_message(stamp, "optical", CAMERA)
        writer.write_message("/d/depth/camera_info", schemas[CAMERA_INFO], message, log_time=stamp)
        unit = {"data": 0.00025}
        writer.write_message(
            "/device_0/sensor_0/option/Depth_Units/value", schemas["unit"], unit, log_time=stamp
        )
        message = image_message(stamp, "optical", frame.depth_mm * 4, "16UC1")
        writer.write_message("/d/depth/image", schemas[IMAGE], message, log_time=stamp)
        writer.finish()
    with open_source(path) as source:
        assert str(source.depth_unit).startswith(
            "4000 per meter (/device_0/sensor_0/option/Depth_Units/value"
        )
        np.testing.assert_array_equal(source.read().depth_mm, frame.depth_mm)
    with open_source(path, SourceOptions(depth_scale=1000.0)) as source:
        np.testing.assert_array_equal(source.read().depth_mm, frame.depth_mm * 4)
