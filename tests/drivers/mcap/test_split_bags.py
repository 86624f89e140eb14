"""Bags of several files, and MCAP files of other messages."""

import logging
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from recorded_scene import APART, scenes
from robot_bag import Bag

from nurbseg.drivers import CalibrationError, RecordingFormatError, RGBDFrame, SourceOptions, open_source

DEPTH, COLOR = "cam_depth_optical", "cam_color_optical"
METADATA = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  relative_file_paths:\n"


def write_part(path: Path, frames: list[RGBDFrame], *, first: bool) -> None:
    """Write frames; CameraInfo and the transform are published once."""
    path.parent.mkdir(exist_ok=True)
    bag = Bag(path)
    if first:
        stamp = frames[0].timestamp_ns
        bag.info("/cam/depth/camera_info", stamp, DEPTH, APART.depth)
        bag.info("/cam/color/camera_info", stamp, COLOR, APART.color)
        bag.transform("/tf_static", stamp, COLOR, DEPTH, APART.color_from_depth)
    for frame in frames:
        bag.image("/cam/depth/image_raw", frame.timestamp_ns, DEPTH, frame.depth_mm, "16UC1")
        bag.image("/cam/color/image_raw", frame.timestamp_ns, COLOR, frame.color, "rgb8")
    bag.close()


@pytest.fixture
def ride(tmp_path: Path) -> Path:
    """A bag of 11 parts with four frames each."""
    frames = scenes(44, APART)
    for part in range(11):
        path = tmp_path / "ride" / f"ride_{part}.mcap"
        write_part(path, frames[4 * part : 4 * part + 4], first=part == 0)
    return tmp_path / "ride"


def list_parts(ride: Path, numbers: list[int], prefix: str = "") -> None:
    lines = "".join(f"    - {prefix}ride_{number}.mcap\n" for number in numbers)
    (ride / "metadata.yaml").write_text(METADATA + lines)


@pytest.mark.parametrize("listed", ["none", "names", "with folder"])
def test_a_folder_of_parts_is_one_recording(ride: Path, listed: str) -> None:
    if listed != "none":
        list_parts(ride, list(range(11)), "ride/" if listed == "with folder" else "")
    with open_source(ride) as source:
        assert source.metadata["frames"] == "44"
        again = list(source)
        for one, other in zip(scenes(44, APART), again, strict=True):
            assert (one.index, one.timestamp_ns) == (other.index, other.timestamp_ns)
            np.testing.assert_array_equal(one.depth_mm, other.depth_mm)
            np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_allclose(again[-1].calibration.color_from_depth, APART.color_from_depth, atol=1e-9)
        source.seek(41)
        assert source.read().timestamp_ns == again[41].timestamp_ns
        source.seek(3)
        assert source.read().index == 3
        assert source.skip(30) == 30
        assert source.read().index == 34


def test_the_metadata_say_the_order_and_which_files_belong_to_it(ride: Path) -> None:
    (ride / "ride_10.mcap").rename(ride / "other.mcap")
    list_parts(ride, [0, 1])
    with open_source(ride) as source:
        assert len(list(source)) == 8


def test_a_missing_part_is_said_and_costs_its_frames(ride: Path, caplog) -> None:
    (ride / "ride_3.mcap").unlink()
    for metadata in (False, True):
        if metadata:
            list_parts(ride, list(range(11)))
        caplog.clear()
        with caplog.at_level(logging.WARNING), open_source(ride) as source:
            assert len(list(source)) == 40
        assert "1 parts of the recording are missing: ride_3.mcap" in caplog.text


def test_a_later_part_by_itself_finds_its_cameras_in_the_first(ride: Path, caplog) -> None:
    with open_source(ride / "ride_7.mcap") as source:
        np.testing.assert_allclose(source.calibration.color_from_depth, APART.color_from_depth, atol=1e-9)
        np.testing.assert_array_equal(source.calibration.color.matrix, APART.color.matrix)
        assert len(list(source)) == 4
    assert f"ride_7.mcap: its cameras are described by {ride / 'ride_0.mcap'}, the first part" in caplog.text
    (ride / "ride_7.mcap").rename(ride.parent / "ride_7.mcap")
    with pytest.raises(CalibrationError, match=r"no sensor_msgs/CameraInfo .*part 8 of a split bag.*folder"):
        open_source(ride.parent / "ride_7.mcap")
    with open_source(ride.parent / "ride_7.mcap", SourceOptions(calibration=APART)) as source:
        assert len(list(source)) == 4


def test_compressed_parts_are_refused_with_the_command_that_unpacks_them(ride: Path) -> None:
    for path in ride.glob("*.mcap"):
        path.rename(path.with_name(f"{path.name}.zstd"))
    with pytest.raises(RecordingFormatError, match=r"ride_0.mcap.zstd: .*zstd -d .*ride_10\.mcap\.zstd"):
        open_source(ride)


def test_metadata_that_are_damaged_are_named(ride: Path) -> None:
    (ride / "metadata.yaml").write_text("a: [")
    with pytest.raises(RecordingFormatError, match=r"metadata\.yaml: not valid YAML"):
        open_source(ride)
    (ride / "metadata.yaml").write_text("rosbag2_bagfile_information: 3\n")
    with open_source(ride) as source:
        assert len(list(source)) == 44


@pytest.mark.parametrize(
    ("profile", "schema", "coding", "encoding", "text"),
    [
        ("ros1", "sensor_msgs/Image", "ros1msg", "ros1", "those of ROS 1.*rosbags-convert"),
        ("", "sensor_msgs/Image", "ros1msg", "ros1", "those of ROS 1"),
        ("", "foxglove.RawImage", "protobuf", "protobuf", r"Foxglove's \(foxglove.RawImage; protobuf\)"),
        ("", "foxglove.CompressedImage", "jsonschema", "json", "Foxglove's .*; json.*not read yet"),
        ("", "my.Image", "flatbuffer", "flatbuffer", "encoded as flatbuffer; only ROS 2's cdr"),
    ],
)
def test_messages_of_others_are_named(
    tmp_path: Path, profile: str, schema: str, coding: str, encoding: str, text: str
) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile)
        channel = writer.register_channel(
            "/camera/depth/image_raw", encoding, writer.register_schema(schema, coding, b"Header header")
        )
        writer.add_message(channel, 1, bytes(100), 1)
        writer.finish()
    with pytest.raises(RecordingFormatError, match=rf"a\.mcap: no topic of depth images.*{text}"):
        open_source(path)
