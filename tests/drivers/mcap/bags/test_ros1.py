"""Bags of ROS 1, written by rosbags: the frames of the same messages, and files that are damaged."""

import logging
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from recorded_scene import APART, scenes, write_mcap
from ros1_bag import to_ros1

from nurbseg.common.errors import BackendMissingError, DriverError, RecordingFormatError
from nurbseg.drivers import open_source
from nurbseg.drivers.mcap.scan import list_streams

pytest.importorskip("rosbags", reason="rosbags is missing: pip install 'nurbseg[bags]'")
FRAMES = 6


@pytest.fixture(scope="module")
def mcap(tmp_path_factory):
    frames = scenes(FRAMES, APART)
    frames[2] = replace(frames[2], world_from_camera=np.eye(4), gravity=[0, 1, 0])
    return write_mcap(tmp_path_factory.mktemp("mcap") / "a.mcap", frames, "png")


@pytest.fixture
def bag(mcap, tmp_path):
    return to_ros1(mcap, tmp_path / "a.bag")


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_the_frames_are_those_of_the_same_messages_in_mcap(mcap, tmp_path, compression):
    path = to_ros1(mcap, tmp_path / "a.bag", compression)
    with open_source(mcap) as expected, open_source(path) as source:
        assert source.metadata["format"] == "ROS 1 bag"
        assert len(source) == FRAMES
        frames = list(source)
        for one, other in zip(expected, frames, strict=True):
            assert one.timestamp_ns == other.timestamp_ns
            for name in ("depth_mm", "color", "labels"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
            np.testing.assert_array_equal(
                one.calibration.color_from_depth, other.calibration.color_from_depth
            )
            np.testing.assert_array_equal(
                one.calibration.color.distortion, other.calibration.color.distortion
            )
        source.seek(1)
        np.testing.assert_array_equal(source.read().depth_mm, frames[1].depth_mm)
    assert list_streams(path) == list_streams(mcap)


@pytest.mark.parametrize("name", ["/camera/depth/image_rect_raw", "/camera/aligned_depth_to_color/image_raw"])
def test_the_topics_of_drivers_of_ros_1_are_found(mcap, tmp_path, name):
    topics = {
        "/camera/depth/image_raw": name,
        "/camera/depth/camera_info": f"{name.rpartition('/')[0]}/camera_info",
    }
    with open_source(to_ros1(mcap, tmp_path / "a.bag", renamed=topics)) as source:
        assert source.metadata["depth_topic"] == name
        assert len(list(source)) == FRAMES


def test_a_recording_of_realsenses_older_sdk_is_named_with_what_converts_it(mcap, tmp_path):
    """It keeps the place of its cameras in messages of its own, which are not read."""
    topics = {"/camera/depth/image_raw": "/device_0/sensor_0/Depth_0/image/data"}
    path = to_ros1(mcap, tmp_path / "a.bag", renamed=topics)
    with pytest.raises(RecordingFormatError, match=r"older RealSense SDK.*convert_bag_to_db3"):
        open_source(path)


def test_without_the_library_it_is_said_what_to_install(bag):
    code = f"""
import sys
sys.modules["rosbags"] = None
from nurbseg.drivers import open_source, BackendMissingError
try:
    open_source({str(bag)!r})
except BackendMissingError as err:
    print(err)
"""
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    assert "pip install 'nurbseg[bags]'" in done.stdout
    assert issubclass(BackendMissingError, DriverError)


def test_one_that_was_not_closed_is_refused_with_what_makes_its_index(bag):
    content = bag.read_bytes()
    place = content.index(b"index_pos=") + len(b"index_pos=")
    bag.write_bytes(content[:place] + bytes(8) + content[place + 8 :])
    with pytest.raises(RecordingFormatError, match=r"not indexed.*rosbag reindex"):
        open_source(bag)


@pytest.mark.parametrize("share", [0.1, 0.4, 0.8, 0.99])
def test_one_that_is_cut_off_is_refused(bag, share):
    content = bag.read_bytes()
    bag.write_bytes(content[: round(share * len(content))])
    with pytest.raises(RecordingFormatError, match="the ROS 1 bag cannot be read"):
        open_source(bag)


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
@pytest.mark.parametrize("seed", range(7))
def test_damage_anywhere_costs_frames_or_is_a_typed_error(mcap, tmp_path, compression, seed, caplog):
    path = to_ros1(mcap, tmp_path / "a.bag", compression)
    content = np.frombuffer(path.read_bytes(), np.uint8).copy()
    rng = np.random.default_rng(seed)
    for place in rng.integers(13, len(content), size=20):
        content[place] = rng.integers(256)
    path.write_bytes(content.tobytes())
    with caplog.at_level(logging.CRITICAL):
        try:
            with open_source(path) as source:
                assert len(list(source)) <= FRAMES
        except DriverError as err:
            assert str(path) in str(err)


def test_a_chunk_that_grows_without_end_costs_itself(mcap, tmp_path, monkeypatch):
    from nurbseg.drivers.mcap.bags import ros1

    path = to_ros1(mcap, tmp_path / "a.bag", "BZ2")
    monkeypatch.setattr(ros1, "CHUNK_BYTES_MAX", 10_000)
    with pytest.raises(RecordingFormatError, match="over 10000 bytes"):
        open_source(path)
