"""nurbseg-record info, and what check says of stamps."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from recorded_scene import APART, CAMERA, INTERVAL_NS, scene, scenes, write_mcap, write_pairs
from robot_bag import Bag

from nurbseg.app.recording.inspection import stamp_findings
from nurbseg.app.recording.record_command import main


def told(capsys, *words: str) -> tuple[int, dict]:
    code = main([*words, "--json"])
    return code, json.loads(capsys.readouterr().out)[0]


def test_the_streams_of_a_recording_are_listed_with_their_sizes_and_rates(tmp_path: Path, capsys) -> None:
    path = write_mcap(tmp_path / "a.mcap", scenes(12, APART))
    code, found = told(capsys, "info", str(path))
    assert code == 0
    streams = {stream["topic"]: stream for stream in found["streams"]}
    depth = streams["/camera/depth/image_raw"]
    assert (depth["encoding"], depth["width"], depth["height"]) == ("16UC1", 64, 48)
    assert (depth["messages"], depth["rate_hz"]) == (12, 30.0)
    assert depth["frame"] == "camera_depth_optical_frame"
    color = streams["/camera/color/image_raw/compressed"]
    assert (color["encoding"], color["width"], color["height"]) == ("bgr8; png compressed", 80, 60)
    assert streams["/tf_static"]["messages"] == 1
    assert found["depth_unit"] == "1000 per meter (ROS REP 118: 16UC1 is in millimeters)"
    assert (found["registered"], found["rate_hz"], found["error"]) == (False, 30.0, "")
    # By hand: 25, 0.6 and 1.2 mm at right angles.
    assert found["baseline_m"] == pytest.approx(0.025036, abs=1e-6)
    assert found["calibration"]["depth"]["fx"] == 57.6
    assert found["metadata"]["color_topic"] == "/camera/color/image_raw/compressed"
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert "16UC1 64x48, frame camera_depth_optical_frame, 12 messages, 30/s  <- depth" in text
    assert "two cameras, 25.0 mm apart" in text
    assert "time: stamps" in text


def test_streams_are_listed_also_of_what_cannot_be_replayed(tmp_path: Path, capsys) -> None:
    bag = Bag(tmp_path / "a.mcap")
    bag.image("/a/depth/image", 10, "optical", scene(0).depth_mm, "16UC1")
    path = bag.close()
    code, found = told(capsys, "info", str(path))
    assert code == 0
    assert "no sensor_msgs/CameraInfo" in found["error"]
    assert [stream["topic"] for stream in found["streams"]] == ["/a/depth/image"]
    assert main(["info", str(path)]) == 0
    assert "cannot be replayed: no sensor_msgs/CameraInfo" in capsys.readouterr().out


def test_the_topics_that_are_replayed_can_be_chosen(tmp_path: Path, capsys) -> None:
    bag = Bag(tmp_path / "a.mcap")
    for name in ("/b", "/a"):
        bag.camera(name, scene(0), CAMERA, scene(0).timestamp_ns)
    path = bag.close()
    assert told(capsys, "info", str(path))[1]["metadata"]["depth_topic"] == "/a/depth/image_raw"
    _, found = told(capsys, "info", str(path), "--depth-topic", "/b/depth/image_raw")
    assert found["metadata"]["color_topic"] == "/b/color/image_raw"
    _, found = told(capsys, "info", str(path), "--depth-topic", "/x")
    assert "--depth-topic /x: no such topic" in found["error"]


def test_a_folder_of_images_has_no_streams_and_something_else_is_an_error(tmp_path: Path, capsys) -> None:
    code, found = told(capsys, "info", str(write_pairs(tmp_path / "pairs", scenes(3))))
    assert (code, found["streams"], found["registered"], found["metadata"]["frames"]) == (0, [], True, "3")
    (tmp_path / "a.txt").write_text("no recording")
    assert main(["info", str(tmp_path / "a.txt")]) == 2
    assert "error: " in capsys.readouterr().err


def test_check_says_what_is_wrong_with_stamps(tmp_path: Path, capsys) -> None:
    frames = [
        replace(each, timestamp_ns=each.timestamp_ns - 5 * 10**9 * (each.index >= 6)) for each in scenes(12)
    ]
    path = write_mcap(tmp_path / "a.mcap", frames)
    code, found = told(capsys, "check", str(path))
    assert (code, found["frames"], found["rate_hz"]) == (0, 12, 30.0)
    assert any("go back once, by up to 4.967 s, after frame 5" in stamp for stamp in found["stamps"])
    bag = Bag(tmp_path / "zeros.mcap")
    for frame in scenes(12):
        bag.camera("/a", frame, CAMERA, 0, frame.timestamp_ns)
    code, found = told(capsys, "check", str(bag.close()))
    assert found["frames"] == 12
    assert found["stamps"] == ["log times (the stamps of depth are 0, or out of range)"]
    _, found = told(capsys, "check", str(write_mcap(tmp_path / "right.mcap", scenes(12))))
    assert found["stamps"] == []


def test_findings_count_what_goes_back_jumps_and_repeats() -> None:
    second = 10**9
    stamps = [0, 1, 2, 2, 40, 41, 11, 12, 7, 8]
    assert stamp_findings([stamp * second for stamp in stamps], {"clock": "stamps"}) == [
        "they go back 2 times, by up to 30.000 s, after frame 5",
        "they jump forward once, by up to 38.000 s, after frame 3",
        "1 frames have the stamp of the one before",
    ]
    assert stamp_findings([index * INTERVAL_NS for index in range(9)], {}) == []
    assert stamp_findings([], {}) == []


def test_a_folder_without_calibration_is_listed_and_what_is_missing_is_said(tmp_path: Path, capsys) -> None:
    folder = write_pairs(tmp_path / "pairs", scenes(3))
    for path in folder.iterdir():
        if path.suffix != ".png":
            path.unlink()
    code, found = told(capsys, "info", str(folder))
    assert (code, found["metadata"]["frames"], found["calibration"], found["registered"]) == (
        0,
        "3",
        {},
        None,
    )
    assert found["sizes"] == {"depth": [64, 48], "color": [64, 48]}
    assert "no calibration" in found["error"]
    assert main(["info", str(folder)]) == 0
    said = capsys.readouterr()
    assert "cannot be replayed: no calibration: give the camera's fx,fy,cx,cy" in said.out
    assert "depth images: 64x48" in said.out
    assert said.err == ""
