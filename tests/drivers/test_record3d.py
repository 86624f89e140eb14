"""Recordings of Record3D, as the tests' own writer makes them from the format's description."""

from __future__ import annotations

import json
import shutil
import struct
import sys
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from bounded_child import read_bounded
from hostile_files import GIB
from record3d_file import CALIBRATION, contents, table, write_r3d, write_zip
from recorded_scene import INTERVAL_NS, scenes

from nurbseg.drivers import BackendMissingError, RecordingFormatError, SourceOptions, open_source
from nurbseg.drivers.record3d import decompress

lzfse = pytest.importorskip("lzfse", reason="LZFSE is missing: pip install 'nurbseg[record3d]'")
#: What one hostile file may take.
TAKEN_MAX = GIB // 2


def read(path: Path, options: SourceOptions | None = None):
    with open_source(path, options) as source:
        return list(source), source


def test_depth_is_exact_and_smaller_than_color(tmp_path):
    frames, source = read(write_r3d(tmp_path / "a.r3d"))
    assert len(frames) == 5
    for frame, expected in zip(frames, scenes(5, CALIBRATION), strict=True):
        np.testing.assert_array_equal(frame.depth_mm, expected.depth_mm)
        assert np.abs(frame.color.astype(int) - expected.color).mean() < 12
        np.testing.assert_allclose(frame.calibration.depth.matrix, CALIBRATION.depth.matrix)
        np.testing.assert_allclose(frame.calibration.color.matrix, CALIBRATION.color.matrix)
        assert frame.timestamp_ns == round(frame.index * 1e9 / 30)
        assert frame.name == str(frame.index)
    assert source.metadata["format"] == "Record3D"
    assert str(source.depth_unit) == "1 per meter (Record3D's own)"
    assert frames[0].calibration is frames[1].calibration


def test_poses_are_those_of_our_camera_in_arkits_world(tmp_path):
    frames, _ = read(write_r3d(tmp_path / "a.r3d"))
    pose = frames[2].world_from_camera
    # Turned by a quarter: what is to the right in the image is up in the world, and we look along -z.
    np.testing.assert_allclose(pose @ [1, 0, 0, 1], [0.2, 3, 3, 1], atol=1e-12)
    np.testing.assert_allclose(pose @ [0, 0, 1, 1], [0.2, 2, 2, 1], atol=1e-12)


def test_a_camera_and_a_time_of_each_frame_count_before_those_of_all(tmp_path):
    cameras = [[100.0 + n, 101.0 + n, 63.0, 47.0] for n in range(5)]
    stamps = [0.5, 0.6, 0.8, 0.9, 1.5]
    path = write_r3d(tmp_path / "a.r3d", perFrameIntrinsicCoeffs=cameras, frameTimestamps=stamps, K=None)
    frames, _ = read(path)
    assert [frame.calibration.color.fx for frame in frames] == [100, 101, 102, 103, 104]
    assert [frame.timestamp_ns for frame in frames] == [
        500000000,
        600000000,
        800000000,
        900000000,
        1500000000,
    ]


def test_sizes_that_are_not_stated_follow_from_the_images(tmp_path):
    frames, _ = read(write_r3d(tmp_path / "a.r3d", w=None, h=None, dw=None, dh=None, fps=None))
    assert frames[4].depth_mm.shape == (48, 64)
    np.testing.assert_allclose(frames[4].calibration.depth.matrix, CALIBRATION.depth.matrix)
    assert frames[1].timestamp_ns == INTERVAL_NS


def test_a_matrix_may_be_by_rows(tmp_path):
    by_rows = [100.0, 0.0, 60.0, 0.0, 100.0, 45.0, 0.0, 0.0, 1.0]
    frames, _ = read(write_r3d(tmp_path / "a.r3d", K=by_rows))
    camera = frames[0].calibration.color
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (100.0, 100.0, 60.0, 45.0)


def test_what_the_user_gives_counts(tmp_path):
    options = SourceOptions(intrinsics=(110.0, 110.0, 63.5, 47.5), depth_scale=2.0)
    frames, _ = read(write_r3d(tmp_path / "a.r3d"), options)
    assert frames[0].calibration.color.fx == 110
    assert frames[0].calibration.depth.fx == 55
    expected = scenes(1, CALIBRATION)[0].depth_mm
    assert np.abs(frames[0].depth_mm.astype(int) - expected / 2).max() <= 1


def test_it_is_known_by_its_content_and_alone_in_a_folder(tmp_path):
    write_r3d(tmp_path / "folder" / "a.r3d").rename(tmp_path / "folder" / "a.zip")
    assert len(read(tmp_path / "folder" / "a.zip")[0]) == 5
    (tmp_path / "folder" / "a.zip").rename(tmp_path / "folder" / "b.r3d")
    assert len(read(tmp_path / "folder")[0]) == 5
    with pytest.raises(RecordingFormatError, match="a zip archive; unpack it"):
        open_source(write_zip(tmp_path / "other.zip", {"a": b""}))


def test_frames_are_in_the_order_of_their_numbers_and_some_may_be_missing(tmp_path):
    files = contents(scenes(12, CALIBRATION))
    for name in ("rgbd/3.depth", "rgbd/5.jpg"):
        del files[name]
    files["metadata"] = json.dumps(table(12, frameTimestamps=[*range(11), 3])).encode()
    path = write_zip(tmp_path / "a.r3d", dict(reversed(files.items())))
    frames, source = read(path)
    assert [frame.name for frame in frames] == ["0", "1", "2", "4", "6", "7", "8", "9", "10", "11"]
    assert source.metadata["damaged"] == "1"
    assert frames[3].timestamp_ns == round(4e9 / 30)


def test_without_the_library_it_is_said_what_to_install(tmp_path, monkeypatch):
    from nurbseg.drivers import record3d as own

    path = write_r3d(tmp_path / "a.r3d")
    monkeypatch.setitem(sys.modules, "lzfse", None)
    own._decoder.cache_clear()
    try:
        with pytest.raises(BackendMissingError, match=r"pip install 'nurbseg\[record3d\]'"):
            open_source(path)
    finally:
        own._decoder.cache_clear()


def block(raw: bytes, stated: int) -> bytes:
    """A block of LZFSE that is not compressed, and states another size."""
    return b"bvx-" + struct.pack("<I", stated) + raw


@pytest.mark.parametrize("size", [0, 1, 11, 100, 12_288, 200_000])
def test_decompressing_gives_what_was_compressed_and_refuses_a_byte_more(size):
    rng = np.random.default_rng(size)
    content = (rng.integers(0, 3, size) * rng.integers(0, 200)).astype(np.uint8).tobytes()
    packed = lzfse.compress(content) if size else b"bvx$"
    if not size:
        with pytest.raises(ValueError, match="damaged"):
            decompress(packed, 10)
        return
    assert decompress(packed, size).tobytes() == content
    assert decompress(packed, size + 1000).tobytes() == content
    with pytest.raises(ValueError, match=f"over {size - 1} bytes"):
        decompress(packed, size - 1)


def test_a_small_stream_of_gigabytes_takes_no_more_than_it_may():
    # Each block becomes 2 MB of zeros from some hundred bytes, and the stream states a small size.
    packed = lzfse.compress(bytes(2_000_000))
    bomb = packed[:-4] * 2000 + b"bvx$"
    with pytest.raises(ValueError, match="over 49152 bytes"):
        decompress(bomb, 49_152)


def with_file(name: str, content: bytes | None):
    def change(files: dict[str, bytes]) -> None:
        if content is None:
            del files[name]
        else:
            files[name] = content

    return change


def with_metadata(**other):
    return with_file("metadata", json.dumps(table(2, **other)).encode())


LZ_BOMB = lzfse.compress(bytes(8_000_000))[:-4] * 500 + b"bvx$"
NAN_METADATA = json.dumps(table(2, K=[float("nan")] * 9)).encode()
#: What is changed in a recording of two frames, how many can be read still, and what is said.
HOSTILE = {
    "no-metadata": (with_file("metadata", None), 0, "metadata: is missing"),
    "metadata-not-json": (with_file("metadata", b"\xff\xfe{"), 0, "metadata: "),
    "metadata-a-list": (with_file("metadata", b"[1]"), 0, "metadata: expected a table"),
    "metadata-nested": (with_file("metadata", b"[" * 1_000_000), 0, "nested too deeply"),
    "metadata-huge": (with_file("metadata", b" " * (17 << 20)), 0, "expected 16777216 at most"),
    "no-camera": (with_metadata(K=None), 0, "K: expected 9 numbers, got None"),
    "camera-nan": (with_file("metadata", NAN_METADATA), 0, "K: expected a finite number"),
    "camera-negative": (with_metadata(K=[-100, 0, 0, 0, -100, 0, 64, 48, 1]), 0, "expected focal lengths"),
    "camera-text": (with_metadata(K=["a"] * 9), 0, "K: expected a finite number, got 'a'"),
    "camera-huge": (with_metadata(K=[10**400, 0, 0, 0, 1, 0, 1, 1, 1]), 0, "K: expected a finite number"),
    "size-huge": (with_metadata(dw=10**9, dh=10**9), 0, "dw: expected pixels, got 1000000000"),
    "size-negative": (with_metadata(w=-5), 0, "w: expected pixels, got -5"),
    "size-of-another-shape": (with_metadata(dw=48, dh=64), 0, "another aspect ratio"),
    "size-larger": (with_metadata(dw=128, dh=96), 0, "expected 128x96 values of 4 bytes, got 12288"),
    "size-smaller": (with_metadata(dw=32, dh=24), 0, "hold over 3072 bytes"),
    "poses-wrong": (with_metadata(poses=[[1, 2], "a"]), 2, ""),
    "poses-zero": (with_metadata(poses=[[0] * 7] * 2), 2, ""),
    "stamps-back": (with_metadata(frameTimestamps=[5, 1]), 2, ""),
    "stamps-huge": (with_metadata(frameTimestamps=[1e300, 2e300]), 2, ""),
    "rate-zero": (with_metadata(fps=0), 2, ""),
    "rate-text": (with_metadata(fps="x"), 2, ""),
    "cameras-ragged": (with_metadata(perFrameIntrinsicCoeffs=[[1], [1, 2]]), 2, ""),
    "depth-empty": (with_file("rgbd/1.depth", b""), 1, "rgbd/1.depth: the LZFSE data are damaged"),
    "depth-cut": (with_file("rgbd/1.depth", lzfse.compress(bytes(12_288))[:20]), 1, "data are damaged"),
    "depth-bomb": (with_file("rgbd/1.depth", LZ_BOMB), 1, "hold over 12288 bytes"),
    "depth-lies": (with_file("rgbd/1.depth", block(b"abc", 0xFFFFFFFF)), 1, "data are damaged"),
    "depth-not-finite": (
        with_file("rgbd/1.depth", lzfse.compress(np.full(3072, np.inf, "<f4").tobytes())),
        2,
        "",
    ),
    "color-no-jpeg": (with_file("rgbd/1.jpg", b"abc"), 1, "not an image that can be decoded"),
    "color-missing": (with_file("rgbd/1.jpg", None), 1, "rgbd/1.jpg: is missing"),
    "color-of-another-shape": (
        with_file("rgbd/1.jpg", cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes()),
        1,
        "another aspect ratio",
    ),
    "names-outside": (with_file("../../../rgbd/7.depth", b"bvx$"), 2, ""),
    "names-of-many-digits": (with_file("rgbd/" + "9" * 5000 + ".depth", b"bvx$"), 2, ""),
    "number-beyond": (with_file("rgbd/999999999.depth", b"bvx$"), 2, "rgbd/999999999.jpg: is missing"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_recording_costs_what_is_wrong_with_it(tmp_path, what):
    change, readable, text = HOSTILE[what]
    files = {"metadata": json.dumps(table(2)).encode(), **contents(scenes(2, CALIBRATION))}
    change(files)
    reading = read_bounded(write_zip(tmp_path / "a.r3d", files))
    assert reading.frames == readable, reading.errors
    assert reading.taken_bytes < TAKEN_MAX, f"{reading.taken_bytes / 2**20:.0f} MB"
    assert all(len(error) < 1000 for error in reading.errors)
    assert any(text in error for error in reading.errors) if text else not reading.errors


def changed(path: Path, place: int, content: bytes) -> Path:
    with path.open("r+b") as file:
        file.seek(place)
        file.write(content)
    return path


def directory(path: Path) -> int:
    """Where the archive's directory begins."""
    return path.read_bytes().index(b"PK\x01\x02")


@pytest.mark.parametrize("what", ["cut", "end-only", "overlap", "method", "encrypted", "crc", "deflate-bomb"])
def test_a_damaged_archive_is_named(tmp_path, what):
    path = write_r3d(tmp_path / "a.r3d", 2)
    content, text = path.read_bytes(), "a.r3d: "
    if what == "cut":
        path.write_bytes(content[: len(content) // 2])
        text = "the archive is damaged or cut off"
    elif what == "end-only":
        path.write_bytes(b"PK\x03\x04" + content[content.index(b"PK\x05\x06") :])
    elif what == "overlap":
        # Every file begins where the first one does.
        place = directory(path)
        for _ in range(9):
            changed(path, place + 42, bytes(4))
            place = path.read_bytes().find(b"PK\x01\x02", place + 1)
            if place < 0:
                break
    elif what in ("method", "encrypted"):
        changed(
            path,
            directory(path) + (10 if what == "method" else 8),
            b"\x0c\0" if what == "method" else b"\1\0",
        )
        text = "metadata: is compressed by method 12" if what == "method" else "metadata: "
    elif what == "crc":
        changed(path, content.index(b"metadata") + 20, b"#")
    else:
        files = {"metadata": b" " * (1 << 30), **contents(scenes(2, CALIBRATION))}
        write_zip(path, files, zipfile.ZIP_DEFLATED)
        text = "metadata: has 1073741824 bytes; expected 16777216 at most"
        # And one that states a small size.
        small = write_zip(tmp_path / "b.r3d", files, zipfile.ZIP_DEFLATED)
        changed(small, directory(small) + 24, struct.pack("<I", 1000))
        reading = read_bounded(small)
        assert (reading.frames, reading.taken_bytes < TAKEN_MAX) == (0, True)
    reading = read_bounded(path)
    assert reading.frames == 0
    assert any(text in error for error in reading.errors), reading.errors
    assert reading.taken_bytes < TAKEN_MAX


def test_an_archive_of_very_many_files_is_refused(tmp_path):
    path = tmp_path / "a.r3d"
    head = struct.pack("<4s6H3I5H2I", b"PK\x01\x02", 20, 20, 0, 0, 0, 0, 0, 0, 0, 8, 0, 0, 0, 0, 0, 0)
    entries = b"".join(head + b"%08d" % number for number in range(400_000))
    end = struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, 65535, 65535, len(entries), 4, 0)
    path.write_bytes(b"PK\x03\x04" + entries + end)
    reading = read_bounded(path)
    assert "its directory has 21600000 bytes; expected 16777216 at most" in reading.errors[0]
    assert reading.taken_bytes < TAKEN_MAX


def test_a_recording_that_is_deleted_while_it_is_read_is_read_on(tmp_path):
    path = write_r3d(tmp_path / "a.r3d")
    with open_source(path) as source:
        source.read()
        path.unlink()
        assert len(list(source)) == 4
    shutil.rmtree(tmp_path)


def test_what_to_do_with_an_unpacked_recording_is_said(tmp_path: Path) -> None:
    with zipfile.ZipFile(write_r3d(tmp_path / "a.r3d", 2)) as archive:
        archive.extractall(tmp_path / "unpacked")
    with pytest.raises(
        RecordingFormatError, match=r"unpacked: a recording of Record3D, unpacked; pack it: cd"
    ):
        open_source(tmp_path / "unpacked")
