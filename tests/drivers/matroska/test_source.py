"""Recordings of k4arecorder, as the tests' own writer makes them, and as ffmpeg does."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bounded_child import read_bounded
from hostile_files import GIB
from kinect_file import (
    COLOR_PARAMETERS,
    COLOR_PRINTED,
    DELAY_NS,
    DEPTH_PRINTED,
    ROTATION,
    START_NS,
    TRANSLATION,
    block,
    calibration,
    element,
    jpeg,
    kinect_frames,
    number,
    parts,
    readings,
    tags,
    track,
    write_mkv,
)

from nurbseg.drivers import CalibrationError, RecordingFormatError, SourceOptions, open_source
from nurbseg.drivers.matroska.kinect_calibration import cameras_of_kinect

#: What one hostile file may take.
TAKEN_MAX = GIB // 2


def read(path: Path, options: SourceOptions | None = None):
    with open_source(path, options) as source:
        return list(source), source


def numbers(camera) -> tuple[float, ...]:
    return camera.fx, camera.fy, camera.cx, camera.cy


def test_the_calibration_for_a_mode_is_that_of_microsofts_sdk():
    cameras = cameras_of_kinect(Path("a.mkv"), calibration(), (640, 576), (1920, 1080))
    found = cameras.calibration(depth_size=(640, 576), color_size=(1920, 1080))
    np.testing.assert_allclose(numbers(found.depth), DEPTH_PRINTED, atol=2e-4)
    np.testing.assert_allclose(numbers(found.color), COLOR_PRINTED, atol=2e-4)
    # k1, k2, p1, p2, k3, ... as it prints them.
    np.testing.assert_allclose(
        found.color.distortion,
        [0.722746, -2.885590, 0.000783, -0.000143, 1.632723, 0.602199, -2.719626, 1.565053],
        atol=1e-6,
    )
    np.testing.assert_allclose(found.color_from_depth[:3, :3], ROTATION)
    np.testing.assert_allclose(found.color_from_depth[:3, 3], TRANSLATION)


@pytest.mark.parametrize(
    ("size", "expected"),
    [((320, 288), (251.96, 251.99, 165.78, 162.69)), ((512, 512), (251.96, 251.99, 261.78, 252.69))],
)
def test_binned_and_wide_modes_are_parts_of_the_same_sensor(size, expected):
    cameras = cameras_of_kinect(Path("a.mkv"), calibration(), size, None)
    found = cameras.calibration(depth_size=size, color_size=size)
    np.testing.assert_allclose(numbers(found.depth), expected, atol=0.01)
    assert found.is_registered


def test_a_color_camera_that_was_calibrated_for_16_to_9_is_the_same():
    # Its rows are those of the middle.
    wide = list(COLOR_PARAMETERS)
    wide[1], wide[3] = (wide[1] * 3072 - 384) / 2304, wide[3] * 3072 / 2304
    lens = calibration()["CalibrationInformation"]["Cameras"][1]["Intrinsics"] | {"ModelParameters": wide}
    table = calibration(Intrinsics=lens, SensorHeight=2304)
    cameras = cameras_of_kinect(Path("a.mkv"), table, (640, 576), (1920, 1080))
    np.testing.assert_allclose(
        numbers(cameras.calibration(depth_size=(640, 576), color_size=(1920, 1080)).color),
        COLOR_PRINTED,
        atol=2e-4,
    )


@pytest.mark.parametrize("form", [b"MJPG", b"NV12", b"YUY2", b"BGRA"])
def test_depth_is_exact_and_stamps_are_the_devices(tmp_path, form):
    expected = kinect_frames(4)
    frames, source = read(write_mkv(tmp_path / "a.mkv", expected, color_form=form))
    assert len(frames) == 4
    for frame, wanted in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.depth_mm, wanted.depth_mm)
        assert np.abs(frame.color.astype(int) - wanted.color).mean() < (0.01 if form == b"BGRA" else 3)
        assert frame.timestamp_ns == wanted.timestamp_ns + DELAY_NS + START_NS
    assert source.metadata["serial"] == "000123"
    assert source.metadata["dropped"] == "0"
    assert str(source.depth_unit) == "1000 per meter (the recorder's own)"
    assert source.calibration.color_from_depth[0, 3] == pytest.approx(-0.032)


def test_gravity_is_that_of_the_readings_near_each_frame(tmp_path):
    downs = np.array([[0.0, 1.0, 0.0], [0.6, 0.8, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]])
    frames = [replace(frame, gravity=down) for frame, down in zip(kinect_frames(4), downs, strict=True)]
    assert np.allclose(
        [each.gravity for each in read(write_mkv(tmp_path / "a.mkv", frames))[0]], downs, atol=1e-6
    )
    whole = parts(frames)
    # One that is shaken says nothing.
    blocks = [whole[f"cluster{n}"] for n in range(4)]
    assert all(each.count(readings(33_333_000 * n, downs[n])) == 1 for n, each in enumerate(blocks))
    whole["cluster1"] = blocks[1].replace(
        readings(33_333_000, downs[1]), readings(33_333_000, 2.0 * downs[1])
    )
    (tmp_path / "b.mkv").write_bytes(b"".join(whole.values()))
    found = [each.gravity for each in read(tmp_path / "b.mkv")[0]]
    assert [each is None for each in found] == [False, True, False, False]
    table = calibration()
    table["CalibrationInformation"]["InertialSensors"][1]["Rt"]["Rotation"] = [0.0] * 9
    assert all(each.gravity is None for each in read(write_mkv(tmp_path / "c.mkv", frames, table=table))[0])


def test_frames_that_lack_an_image_are_dropped(tmp_path):
    made = parts(kinect_frames(5))
    made["cluster1"] = made["cluster1"].replace(b"\x81\0\0\x80", b"\x85\0\0\x80", 1)
    made["cluster3"] = made["cluster3"].replace(b"\x82\0\xa0\x80", b"\x85\0\xa0\x80", 1)
    (tmp_path / "a.mkv").write_bytes(b"".join(made.values()))
    frames, source = read(tmp_path / "a.mkv")
    assert [(frame.timestamp_ns - START_NS) // 33_333_000 for frame in frames] == [0, 2, 4]
    assert source.metadata["dropped"] == "2"


def test_without_color_it_is_gray_and_registered(tmp_path):
    made = parts(kinect_frames(2))
    made["tracks"] = element(0x1654AE6B, track(2, "DEPTH", b"b16g", (320, 288)))
    (tmp_path / "a.mkv").write_bytes(b"".join(made.values()))
    frames, source = read(tmp_path / "a.mkv")
    assert (frames[0].color == 128).all() and frames[0].color.shape == (288, 320, 3)
    assert source.calibration.is_registered
    assert frames[0].timestamp_ns == START_NS + DELAY_NS


def test_what_the_user_gives_counts(tmp_path):
    made = parts(kinect_frames(1, (320, 240), (640, 480)))
    del made["attachments"]
    (tmp_path / "a.mkv").write_bytes(b"".join(made.values()))
    with pytest.raises(CalibrationError, match=r"no calibration\.json is attached; give --calibration"):
        open_source(tmp_path / "a.mkv")
    frames, _ = read(
        tmp_path / "a.mkv", SourceOptions(intrinsics=(500.0, 500.0, 320.0, 240.0), depth_scale=500.0)
    )
    assert numbers(frames[0].calibration.color) == (500.0, 500.0, 320.0, 240.0)
    assert frames[0].depth_mm[0, 1] == 2 * 1005


def test_one_that_is_cut_off_or_damaged_is_replayed_up_to_there(tmp_path, caplog):
    content = write_mkv(tmp_path / "a.mkv", kinect_frames(5)).read_bytes()
    (tmp_path / "a.mkv").write_bytes(content[: len(content) * 7 // 10])
    assert len(read(tmp_path / "a.mkv")[0]) == 3
    assert "the file is cut off after" in caplog.text
    made = parts(kinect_frames(5))
    made["cluster3"] = b"\0" * 1000
    (tmp_path / "b.mkv").write_bytes(b"".join(made.values()))
    assert len(read(tmp_path / "b.mkv")[0]) == 3
    assert "is damaged: the element at byte" in caplog.text


def test_ffmpeg_reads_what_the_tests_write_and_writes_what_we_read(tmp_path):
    """An independent reader and writer of Matroska: its copies keep milliseconds."""
    av = pytest.importorskip("av", reason="ffmpeg's libraries are missing: pip install av")
    expected, table = kinect_frames(4), json.dumps(calibration()).encode()
    write_mkv(tmp_path / "a.mkv", expected)
    given = av.open(tmp_path / "a.mkv")
    made = av.open(tmp_path / "b.mkv", "w", options={"allow_raw_vfw": "1"})
    with given, made:
        assert given.streams.attachments[0].data == table
        color, depth = given.streams.video[:2]
        assert depth.codec_context.codec_tag == "b16g"
        streams = {each.index: made.add_stream_from_template(each) for each in (color, depth)}
        for index, stream in streams.items():
            stream.metadata["title"] = given.streams[index].metadata["title"]
        made.metadata.update(given.metadata)
        made.add_attachment("calibration.json", "application/octet-stream", table)
        found = []
        for packet in given.demux(color, depth):
            if packet.dts is not None:
                if packet.stream is depth:
                    found.append((float(packet.pts * packet.time_base), bytes(packet)))
                packet.stream = streams[packet.stream.index]
                made.mux(packet)
    for (time_s, content), wanted in zip(found, expected, strict=True):
        assert content == wanted.depth_mm.astype(">u2").tobytes()
        assert round(time_s * 1e9) == wanted.timestamp_ns + DELAY_NS
    # It does not write the form of raw images.
    head = struct.pack("<Iii2H", 40, 320, -288, 1, 16)
    content = (tmp_path / "b.mkv").read_bytes()
    with pytest.raises(RecordingFormatError, match=r"b\.mkv: depth: is of the form ''; expected b16g"):
        open_source(tmp_path / "b.mkv")
    (tmp_path / "b.mkv").write_bytes(content.replace(head + bytes(4), head + b"b16g"))
    frames, source = read(tmp_path / "b.mkv")
    assert source.metadata["serial"] == "000123"
    for frame, wanted in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(frame.depth_mm, wanted.depth_mm)
        assert abs(frame.timestamp_ns - wanted.timestamp_ns - DELAY_NS - START_NS) <= 1_000_000


def test_an_ordinary_video_is_said_to_be_one(tmp_path):
    made = parts(kinect_frames(1))
    made["tracks"] = element(0x1654AE6B, track(1, "", b"MJPG", (1280, 720)))
    (tmp_path / "a.mkv").write_bytes(b"".join(made.values()))
    with pytest.raises(RecordingFormatError, match="a Matroska video without depth of k4arecorder"):
        open_source(tmp_path / "a.mkv")


def part(name: str, content: bytes | Callable[[dict[str, bytes]], bytes]):
    def change(made: dict[str, bytes]) -> None:
        made[name] = content if isinstance(content, bytes) else content(made)

    return change


def lens(**changes):
    color = calibration()["CalibrationInformation"]["Cameras"][1]["Intrinsics"] | changes
    return attached(json.dumps(calibration(Intrinsics=color)).encode())


def attached(content: bytes):
    return part("attachments", element(0x1941A469, element(0x61A7, element(0x465C, content))))


def tracks(depth: bytes | None = None, color: bytes | None = None):
    depth = track(2, "DEPTH", b"b16g", (320, 288)) if depth is None else depth
    color = track(1, "COLOR", b"MJPG", (1280, 720)) if color is None else color
    return part("tracks", element(0x1654AE6B, color, depth))


def images(time: int = 33_333, depth: bytes | None = None, color: bytes | None = None, flags: int = 0x80):
    frame = kinect_frames(2)[1]
    depth = frame.depth_mm.astype(">u2").tobytes() if depth is None else depth
    color = jpeg(frame.color) if color is None else color
    blocks = block(1, 0, color, flags), block(2, 160, depth, flags)
    return part("cluster1", element(0x1F43B675, number(0xE7, time), *blocks))


def in_reverse(made: dict[str, bytes]) -> None:
    made["cluster0"], made["cluster1"] = made["cluster1"], made["cluster0"]


def without_content(made: dict[str, bytes]) -> None:
    for each in [*made][2:]:
        del made[each]


def table(**changes) -> bytes:
    return json.dumps(calibration(**changes)).encode()


NAN = [float("nan")] * 14
NEGATIVE = [0.5, 0.5, -0.5, -0.5, *[0.0] * 10]
#: What is changed in a recording of two frames, how many can be read still, and what is said.
HOSTILE = {
    "no-calibration": (attached(b"{}"), 0, "no calibration.json is attached"),
    "calibration-not-json": (attached(b"CalibrationInformation {"), 0, "not valid JSON"),
    "calibration-nested": (attached(b'{"CalibrationInformation":' + b"[" * 99_999), 0, "nested too deeply"),
    "calibration-a-list": (
        attached(b'["CalibrationInformation"]'),
        0,
        "Cameras: expected those at D0 and PV0",
    ),
    "calibration-no-cameras": (
        attached(b'{"CalibrationInformation": {"Cameras": [1]}}'),
        0,
        "Cameras: expected",
    ),
    "calibration-huge": (attached(b"CalibrationInformation" + bytes(1 << 19)), 0, "no calibration.json is"),
    "lens-nan": (lens(ModelParameters=NAN), 0, "PV0.ModelParameters: expected a finite number"),
    "lens-negative": (lens(ModelParameters=NEGATIVE), 0, "expected focal lengths"),
    "lens-short": (lens(ModelParameters=[1]), 0, "PV0.ModelParameters: expected 14 numbers"),
    "lens-other": (lens(ModelType="CALIBRATION_LensDistortionModelTheta"), 0, "'Theta' is not OpenCV's"),
    "pose-none": (attached(table(Rt=5)), 0, "PV0.Rotation: expected 9 numbers"),
    "pose-zeros": (
        attached(table(Rt={"Rotation": [0] * 9, "Translation": [0] * 3})),
        0,
        "PV0.Rotation: expected a rotation",
    ),
    "sensor-zero": (attached(table(SensorWidth=0)), 0, "PV0.SensorWidth: expected pixels"),
    "size-of-no-mode": (tracks(track(2, "DEPTH", b"b16g", (144, 640))), 0, "144x640 is no mode"),
    "size-huge": (tracks(track(2, "DEPTH", b"b16g", (1 << 40, 1 << 40))), 0, "depth: width: expected pixels"),
    "size-zero": (tracks(track(2, "DEPTH", b"b16g", (0, 0))), 0, "depth: width: expected pixels"),
    "size-of-color": (
        tracks(color=track(1, "COLOR", b"MJPG", (1920, 1080))),
        0,
        "color: has 1280x720 pixels",
    ),
    "depth-as-video": (tracks(track(2, "DEPTH", b"H264", (320, 288))), 0, "of the form 'H264'"),
    "tracks-compressed": (
        tracks(track(2, "DEPTH", b"b16g", (320, 288), element(0x6D80, b""))),
        0,
        "once more",
    ),
    "tracks-cut": (part("tracks", element(0x1654AE6B, b"\xae\xff")), 0, "without depth"),
    "tracks-huge": (part("tracks", element(0x1654AE6B, bytes(2 << 20))), 0, "without depth"),
    "scale-zero": (part("info", element(0x1549A966, number(0x2AD7B1, 0))), 0, "no depth and color"),
    "scale-huge": (part("info", element(0x1549A966, element(0x2AD7B1, b"\xff" * 8))), 0, ""),
    "scale-of-9-bytes": (
        part("info", element(0x1549A966, element(0x2AD7B1, b"\xff" * 9))),
        0,
        "without depth",
    ),
    "offset-text": (part("tags", tags(K4A_START_OFFSET_NS="x" * 5000)), 2, ""),
    "offset-huge": (part("tags", tags(K4A_START_OFFSET_NS="9" * 18)), 2, ""),
    "offset-negative": (part("tags", tags(K4A_START_OFFSET_NS="-5000000000")), 2, ""),
    "delay-huge": (
        part("tags", tags(K4A_DEPTH_DELAY_NS="9" * 18)),
        0,
        "no depth and color were taken within",
    ),
    "tags-deep": (part("tags", element(0x1254C367, *[b"\x73\x73\x88"] * 1000)), 0, "without depth"),
    "depth-short": (images(depth=b"abc"), 1, "depth: has 3 bytes, not those of 320x288"),
    "depth-empty": (images(depth=b""), 1, "depth: has 0 bytes"),
    "color-no-jpeg": (images(color=b"abc"), 1, "color: not an image that can be decoded"),
    "images-laced": (images(flags=0x86), 1, ""),
    "time-huge": (images(time=1 << 63), 1, ""),
    "time-same": (images(time=0), 2, ""),
    "time-back": (in_reverse, 2, ""),
    "cluster-of-no-size": (
        part("cluster1", lambda made: b"\x1f\x43\xb6\x75\xff" + made["cluster1"][12:]),
        2,
        "",
    ),
    "element-of-no-size": (part("seek", b"\xec\xff"), 0, "without depth"),
    "element-of-exabytes": (part("seek", b"\xec\x01" + b"\xff" * 6 + b"\xfe"), 0, "without depth"),
    "segment-only": (without_content, 0, "without depth"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_recording_costs_what_is_wrong_with_it(tmp_path, what):
    change, readable, text = HOSTILE[what]
    made = parts(kinect_frames(2))
    change(made)
    (tmp_path / "a.mkv").write_bytes(b"".join(made.values()))
    reading = read_bounded(tmp_path / "a.mkv")
    assert reading.frames == readable, reading.errors
    assert reading.taken_bytes < TAKEN_MAX, f"{reading.taken_bytes / 2**20:.0f} MB"
    assert all(len(error) < 1000 for error in reading.errors)
    if text:
        assert any(text in error for error in reading.errors), reading.errors


@pytest.mark.parametrize(
    ("limit", "content", "said"),
    [
        ("elements._ELEMENTS_MAX", b"\xec\x80" * 100, "expected 60 elements at most"),
        ("listing.LIST_LINES_MAX", b"\xa3\x84\x82\0\0\x80" * 100, "expected 60 images at most"),
    ],
)
def test_very_many_elements_end_the_search(tmp_path, monkeypatch, caplog, limit, content, said):
    monkeypatch.setattr(f"nurbseg.drivers.matroska.{limit}", 60)
    path = write_mkv(tmp_path / "a.mkv", kinect_frames(2))
    path.write_bytes(path.read_bytes() + content)
    with open_source(path) as source:
        source.read()
    assert said in caplog.text


def test_tables_of_a_gigabyte_are_not_read(tmp_path):
    path = write_mkv(tmp_path / "a.mkv", kinect_frames(2))
    path.write_bytes(path.read_bytes() + element(0x1941A469, size=GIB))
    os.truncate(path, 2 * GIB)
    reading = read_bounded(path)
    assert reading.frames == 2
    assert reading.taken_bytes < TAKEN_MAX


def test_any_byte_that_is_changed_is_an_error_of_ours_at_most(tmp_path):
    content = write_mkv(tmp_path / "a.mkv", kinect_frames(2)).read_bytes()
    rng = np.random.default_rng(5)
    head = content.index(b"\x1f\x43\xb6\x75")
    for number_of in range(300):
        changed = bytearray(content)
        for place in rng.integers(4, head + 60, rng.integers(1, 4)):
            changed[place] = rng.integers(256)
        path = tmp_path / f"{number_of}.mkv"
        path.write_bytes(changed)
        try:
            with open_source(path) as source:
                for frame in source:
                    assert frame.timestamp_ns >= 0
        except RecordingFormatError as err:
            assert str(path) in str(err), str(err)
        path.unlink()
